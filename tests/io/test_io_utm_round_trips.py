"""Every writer keeps a scene in UTM coordinates to a micrometer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from epipole.geometry import Rigid3, Similarity3
from epipole.io.colmap.model import read_colmap_model, write_colmap_model
from epipole.io.g2o import read_g2o, write_g2o
from epipole.io.meshes.ply import read_points_ply, write_scene_ply
from epipole.io.models.bundler import write_bundler
from epipole.io.models.transforms import read_transforms, write_transforms
from epipole.io.trajectories.files import TrajectoryFormat, read_trajectory, write_trajectory
from epipole.optim import PoseGraph
from epipole.scene import Reconstruction, Trajectory
from io_models import mappable_model, small_model

UTM = np.array([500_000.0, 5_200_000.0, 300.0])
TOLERANCE_M = 1e-6


def scene_in_utm() -> Reconstruction:
    return small_model().transformed(Similarity3(np.array(1.0), np.eye(3), UTM))


def registered_centers(model: Reconstruction) -> np.ndarray:
    return model.camera_centers_in_world()[model.is_registered()]


def assert_same(read: Reconstruction, model: Reconstruction) -> None:
    centers = registered_centers(read)
    np.testing.assert_allclose(centers, registered_centers(model), rtol=0, atol=TOLERANCE_M)
    np.testing.assert_allclose(read.points.xyz_in_world, model.points.xyz_in_world, rtol=0, atol=TOLERANCE_M)


@pytest.mark.parametrize("is_text", [False, True])
def test_colmap(tmp_path: Path, is_text: bool) -> None:
    model = scene_in_utm()
    write_colmap_model(model, tmp_path, text=is_text)
    assert_same(read_colmap_model(tmp_path), model)


def test_transforms(tmp_path: Path) -> None:
    model = scene_in_utm()
    known = model.is_registered()
    write_transforms(model, tmp_path / "transforms.json")
    read = read_transforms(tmp_path / "transforms.json")
    assert sorted(read.images.name) == sorted(n for n, k in zip(model.images.name, known) if k)
    assert_same(read, model)


def test_scene_ply(tmp_path: Path) -> None:
    model = scene_in_utm()
    write_scene_ply(tmp_path / "scene.ply", model)
    xyz = read_points_ply(tmp_path / "scene.ply").xyz
    n = len(model.points)
    np.testing.assert_allclose(xyz[:n], model.points.xyz_in_world, rtol=0, atol=TOLERANCE_M)
    np.testing.assert_allclose(xyz[n::5], registered_centers(model), rtol=0, atol=TOLERANCE_M)


def test_bundler(tmp_path: Path) -> None:
    model = mappable_model().transformed(Similarity3(np.array(1.0), np.eye(3), UTM))
    write_bundler(model, tmp_path / "bundle.out")
    lines = (tmp_path / "bundle.out").read_text().splitlines()[2:]
    n = int(model.is_registered().sum())
    cameras = np.array([line.split() for line in lines[: 5 * n]], float).reshape(n, 5, 3)
    centers = -np.einsum("nji,nj->ni", cameras[:, 1:4], cameras[:, 4])
    np.testing.assert_allclose(centers, registered_centers(model), rtol=0, atol=TOLERANCE_M)
    xyz = np.array([line.split() for line in lines[5 * n :: 3]], float)
    np.testing.assert_allclose(xyz, model.points.xyz_in_world, rtol=0, atol=TOLERANCE_M)


def world_from_body() -> Rigid3:
    rng = np.random.default_rng(0)
    near = Rigid3.exp(rng.normal(size=(20, 6)))
    return Rigid3(near.rotation, near.translation + UTM)


@pytest.mark.parametrize("kind", ["tum", "kitti", "euroc"])
def test_trajectories(tmp_path: Path, kind: TrajectoryFormat) -> None:
    path = tmp_path / ("t.csv" if kind == "euroc" else "t.txt")
    covariance = np.tile(np.diag([1 / 3, 2e-9, 1e4, 1 / 7, 0.1, 1.0]), (20, 1, 1))
    trajectory = Trajectory(np.arange(20) * 0.1, world_from_body(), covariance)
    write_trajectory(trajectory, path, kind, with_covariance=kind == "tum")
    read = read_trajectory(path, kind)
    wanted = trajectory.world_from_body
    np.testing.assert_allclose(read.world_from_body.translation, wanted.translation, rtol=0, atol=TOLERANCE_M)
    np.testing.assert_allclose(read.world_from_body.rotation, wanted.rotation, rtol=0, atol=1e-12)
    if kind == "tum":
        np.testing.assert_array_equal(read.covariance, covariance)


def test_pose_graph(tmp_path: Path) -> None:
    poses = world_from_body()
    first, second = np.arange(19), np.arange(1, 20)
    steps = poses[first].inverse() @ poses[second]
    write_g2o(tmp_path / "g.g2o", PoseGraph(poses, first, second, steps, np.tile(np.eye(6), (19, 1, 1))))
    read = read_g2o(tmp_path / "g.g2o").graph.world_from_body
    np.testing.assert_allclose(read.translation, poses.translation, rtol=0, atol=TOLERANCE_M)
