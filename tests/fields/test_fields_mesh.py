"""Meshes of fields: `epipole.mesh` of every kind of field, boxes, components, and files."""

import numpy as np
import pytest
from fields_scenes import CAMERA
from plyfile_of import mesh_in
from scipy.spatial import cKDTree

from epipole import mesh, nerf, splat
from epipole.cli.main import main
from epipole.errors import ConfigError, DegenerateGeometryError, FileFormatError, NoModelError, ShapeError
from epipole.io.meshes.mesh_ply import first_view_of_mesh, write_mesh_ply
from epipole.scene import Mesh
from whole import IS_WHOLE, in_whole_run


def test_files_hold_the_triangles(tmp_path):
    vertices, faces = np.eye(4, 3), np.array([[0, 1, 2], [1, 2, 3]])
    write_mesh_ply(tmp_path / "a.ply", vertices, faces, np.arange(12).reshape(4, 3))
    found = mesh_in(tmp_path / "a.ply")
    np.testing.assert_allclose(found[0], vertices)
    np.testing.assert_array_equal(found[1], faces)
    np.testing.assert_array_equal(found[2], np.arange(12).reshape(4, 3))
    with pytest.raises(ShapeError, match="a missing vertex"):
        write_mesh_ply(tmp_path / "b.ply", vertices, faces + 1, np.zeros((4, 3), np.uint8))
    with pytest.raises(ShapeError, match="rgb"):
        write_mesh_ply(tmp_path / "b.ply", vertices, faces, np.zeros((3, 3), np.uint8))
    assert not (tmp_path / "b.ply").exists()


@pytest.mark.parametrize("kind", ["splat"] + IS_WHOLE * ["grid"])
def test_a_trained_field_has_a_surface(source, tmp_path, kind):
    if kind == "splat":
        splat(source, tmp_path / "out", steps=80, max_gaussians=500, test_every=0)
    else:
        nerf(source, tmp_path / "out", steps=60, kind=kind, test_every=0)
    found = mesh(tmp_path / "out", tmp_path / "mesh.ply", voxels=48)
    vertices, faces, _ = mesh_in(tmp_path / "mesh.ply")
    assert len(faces) == len(found) > 500 and len(vertices) == len(found.vertices_in_world)
    assert np.percentile(np.linalg.norm(vertices, axis=1), 95) < 1.2
    assert (found.rgb == 160).all(axis=1).mean() < 0.001  # gray is the color of vertices that no view shows
    position, target, _ = first_view_of_mesh(tmp_path / "mesh.ply")
    assert np.linalg.norm(target) < 1.2 < np.linalg.norm(position)
    again = mesh(
        tmp_path / "out", tmp_path / "b.ply", voxels=48, cameras=source / "transforms.json", max_views=5
    )
    assert len(again) > 200


@in_whole_run
def test_voxels_finer_than_the_pixels_are_filled(source, tmp_path):
    splat(source, tmp_path / "out", steps=30, max_gaussians=300, test_every=0)
    sharp, enlarged = (
        mesh(tmp_path / "out", tmp_path / f"{width}.ply", voxels=256, width=width) for width in (256, 32)
    )
    assert len(enlarged) == pytest.approx(len(sharp), rel=0.05)
    distance = cKDTree(sharp.vertices_in_world).query(enlarged.vertices_in_world)[0]
    assert np.quantile(distance, 0.9) < 2.0 / 256  # a voxel


def test_what_gives_no_mesh(source, tmp_path):
    with pytest.raises(FileFormatError, match="it does not exist"):
        mesh(tmp_path / "none", tmp_path / "a.ply")
    splat(source, tmp_path / "out", steps=2, test_every=0)
    (tmp_path / "alone.ply").write_bytes((tmp_path / "out" / "splat.ply").read_bytes())
    with pytest.raises(NoModelError, match=r"pass a transforms\.json"):
        mesh(tmp_path / "alone.ply", tmp_path / "a.ply")
    with pytest.raises(ConfigError, match="voxels"):
        mesh(tmp_path / "out", tmp_path / "a.ply", voxels=2)
    for wrong in ("a.obj", "out"):
        with pytest.raises(ConfigError, match=r"ends in \.ply"):
            mesh(tmp_path / "out", tmp_path / wrong)
    assert not (tmp_path / "a.ply").exists() and CAMERA.width == 64


def patch(n, at):
    """A grid of n x n quads at a height: 2 n^2 triangles."""
    row, column = np.mgrid[: n + 1, : n + 1]
    vertices = np.stack([row, column, np.full(row.shape, at)], axis=2).reshape(-1, 3).astype(float)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    return vertices, np.concatenate(
        [np.stack([a, a + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + n + 1], 1)]
    )


def test_small_components_are_removed():
    parts = [patch(n, 10.0 * k) for k, n in enumerate((10, 1, 3, 1, 10))]
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    whole = Mesh(
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([faces + offset for (_, faces), offset in zip(parts, offsets)]),
        np.arange(offsets[-1] * 3, dtype=np.uint8).reshape(-1, 3),
    )
    for least, left, removed in (
        (0.0, (0, 1, 2, 3, 4), 0),
        (0.02, (0, 2, 4), 2),
        (0.1, (0, 4), 3),
        (1.0, (0, 4), 3),
    ):
        found = whole.without_small_components(least)
        assert (found.num_components, found.num_removed) == (5, removed)
        assert sorted(set(found.vertices_in_world[:, 2] / 10)) == list(left)
        assert len(found) == sum(len(parts[k][1]) for k in left)
        before, after = (m.vertices_in_world[m.faces].reshape(-1, 9) for m in (whole, found))
        assert {row.tobytes() for row in after} <= {row.tobytes() for row in before}
        colors = {v.tobytes(): c.tobytes() for v, c in zip(whole.vertices_in_world, whole.rgb)}
        assert all(colors[v.tobytes()] == c.tobytes() for v, c in zip(found.vertices_in_world, found.rgb))
    nothing = Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.int64), np.zeros((3, 3), np.uint8))
    assert len(nothing.without_small_components(0.01).vertices_in_world) == 0


def test_a_box_is_meshed_alone_and_removed_components_are_said(source, tmp_path, capsys):
    splat(source, tmp_path / "out", steps=30, max_gaussians=300, test_every=0)
    job = ["--voxels", "64", "--box", "-1", "-1", "-1", "0.25", "1", "1"]
    main(["mesh", str(tmp_path / "out"), str(tmp_path / "a.ply"), *job, "--min-component", "0"])
    assert "removed" not in capsys.readouterr().out
    every = mesh_in(tmp_path / "a.ply")[0]
    assert every[:, 0].max() <= 0.25 + 1e-6 and (every >= -1).all() and every[:, 0].min() < -0.3
    main(["mesh", str(tmp_path / "out"), str(tmp_path / "a.ply"), *job, "--min-component", "0.5"])
    said = " ".join(capsys.readouterr().out.split())
    assert "components with fewer triangles than 50 % of the largest" in said
    assert 0 < len(mesh_in(tmp_path / "a.ply")[0]) < len(every)
    with pytest.raises(DegenerateGeometryError, match="no surface"):
        mesh(tmp_path / "out", tmp_path / "b.ply", box=(50.0, 50.0, 50.0, 51.0, 51.0, 51.0), voxels=16)
    for wrong in ({"box": (0.0, 0.0, 0.0, 1.0, 0.0, 1.0)}, {"min_component": -0.1}, {"box": (0.0, 1.0)}):
        with pytest.raises(ConfigError, match=r"box|min_component"):
            mesh(tmp_path / "out", tmp_path / "b.ply", **wrong)
