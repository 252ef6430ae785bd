"""PLY files far from the origin keep their coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from epipole.io.meshes.mesh_ply import read_mesh_ply, write_mesh_ply
from epipole.io.meshes.ply import read_points_ply, write_points_ply

UTM = np.array([500_000.0, 5_200_000.0, 300.0])


@pytest.mark.parametrize("num_points", [1, 200])
def test_points_and_meshes_in_utm(tmp_path: Path, num_points: int) -> None:
    rng = np.random.default_rng(0)
    xyz = UTM + rng.normal(size=(num_points, 3)) * 20.0
    rgb = rng.integers(0, 256, (num_points, 3)).astype(np.uint8)
    write_points_ply(tmp_path / "p.ply", xyz, rgb)
    read = read_points_ply(tmp_path / "p.ply")
    np.testing.assert_array_equal(read.xyz, xyz)
    np.testing.assert_array_equal(read.rgb, rgb)
    faces = np.zeros((1, 3), int) if num_points < 3 else np.array([[0, 1, 2]])
    write_mesh_ply(tmp_path / "m.ply", xyz, faces, rgb)
    mesh = read_mesh_ply(tmp_path / "m.ply")
    np.testing.assert_array_equal(mesh.xyz, xyz)
    np.testing.assert_array_equal(mesh.rgb, rgb)


def test_a_point_at_infinity_does_not_hide_the_offset(tmp_path: Path) -> None:
    xyz = np.concatenate(
        [UTM + np.random.default_rng(1).normal(size=(50, 3)), [[np.nan, 0, 0], [1e15, 0, 0]]]
    )
    write_points_ply(tmp_path / "p.ply", xyz, np.zeros((52, 3), np.uint8))
    np.testing.assert_array_equal(read_points_ply(tmp_path / "p.ply").xyz, xyz)


def test_points_near_the_origin_stay_in_single_precision(tmp_path: Path) -> None:
    xyz = np.random.default_rng(2).normal(size=(50, 3)) * 100.0 + 300.0
    write_points_ply(tmp_path / "p.ply", xyz, np.zeros((50, 3), np.uint8))
    head = (tmp_path / "p.ply").read_bytes()[:200]
    assert head.startswith(b"ply\nformat binary_little_endian 1.0\n") and b"property float x" in head
    np.testing.assert_array_equal(read_points_ply(tmp_path / "p.ply").xyz, xyz.astype(np.float32))
