"""`epipole.nerf`: from cameras and pictures to a grid, held-out pictures and figures; its file; and drawing it."""

import json

import numpy as np
import pytest
from fields_scenes import CAMERA, views
from test_fields_run import frames_of, lens

from epipole import nerf, render
from epipole.errors import ConfigError, DegenerateGeometryError, FileFormatError
from epipole.fields import render as draw
from epipole.fields.photometric import psnr
from epipole.fields.voxel_field import draw_voxels, gaussians_of
from epipole.io.photographs import read_rgb
from epipole.io.voxel_files import GridContents, read_grid, write_grid
from epipole.pipelines.fields.scene import is_mine, read_voxels, splat_view


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nerf") / "scene"
    folder.mkdir()
    (folder / "transforms.json").write_text(json.dumps(lens() | {"frames": frames_of(views(), folder)}))
    return folder


@pytest.fixture(scope="module")
def result(source, tmp_path_factory):
    return nerf(source, tmp_path_factory.mktemp("nerf") / "out", test_every=7, steps=60)


def test_results_are_written(result):
    metrics = json.loads((result.out / "metrics.json").read_text())
    assert metrics["num_train"] == 12 and metrics["num_test"] == 2 and metrics["steps"] == 60
    assert metrics["psnr"] > 20 and metrics["background"] == "white" and metrics["kind"] == "grid"
    assert sorted(path.name for path in (result.out / "test").iterdir()) == ["images_00.png", "images_07.png"]
    assert (
        metrics["num_voxels"] == len(result.voxels.values) == len(read_voxels(result.out / "grid.npz").values)
    )


def test_what_is_read_draws_the_same(result):
    found, place = read_voxels(result.out / "grid.npz"), views()[3].cam_from_world
    one, other = (draw_voxels(v, CAMERA, place, np.ones(3))[0] for v in (result.voxels, found))
    assert np.abs(one - other).max() < 5e-3 and one.min() < 0.7


def test_the_command_draws_it(result, source, tmp_path):
    render(result.out, tmp_path / "out", cameras=source / "transforms.json")
    found = read_rgb(tmp_path / "out" / "07.png")
    assert np.abs(found.astype(int) - read_rgb(result.out / "test" / "images_07.png")).max() <= 2
    render(result.out / "grid.npz", tmp_path / "round", frames=2, width=32)
    assert read_rgb(tmp_path / "round" / "00000.png").min() < 200


def test_its_gaussians_look_like_it(result):
    assert is_mine(result.out) and is_mine(result.out / "grid.npz") and not is_mine(result.out / "test")
    cloud, place = splat_view(result.out).cloud, views()[3].cam_from_world
    assert cloud.sh_degree == 1 and len(gaussians_of(result.voxels, 50)) == 50
    one = draw(cloud, CAMERA, place).over(np.ones(3, np.float32))
    other = draw_voxels(result.voxels, CAMERA, place, np.ones(3))[0]
    assert psnr(one, np.clip(other, 0, 1)) > psnr(np.ones_like(other), np.clip(other, 0, 1)) + 3.0
    with pytest.raises(DegenerateGeometryError, match="empty"):
        gaussians_of(result.voxels._replace(values=np.zeros_like(result.voxels.values)), 50)


def test_wrong_files(tmp_path, rng):
    cells = rng.uniform(size=(3, 4, 5)) < 0.5
    write_grid(tmp_path / "a.npz", GridContents(cells, np.zeros((7, 13), np.float32), np.zeros(3), 0.1, 0.2))
    assert (read_grid(tmp_path / "a.npz").cells == cells).all()
    with pytest.raises(FileFormatError, match="7 rows of values"):
        read_voxels(tmp_path / "a.npz")
    (tmp_path / "b.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:-30])
    with pytest.raises(FileFormatError, match="no grid"):
        read_grid(tmp_path / "b.npz")
    np.savez(
        tmp_path / "c.npz",
        shape=np.array([10**9] * 3, np.int32),
        place=np.ones(5),
        cells=np.zeros(1),
        values=np.zeros(1),
    )
    with pytest.raises(FileFormatError, match="impossible size"):
        read_grid(tmp_path / "c.npz")


def test_what_cannot_be_trained(source, tmp_path):
    with pytest.raises(ConfigError, match="seed"):
        nerf(source, tmp_path / "out", seed=-1)
    with pytest.raises(FileFormatError, match="no such file"):
        nerf(tmp_path / "none", tmp_path / "out")
    same = tmp_path / "same"
    same.mkdir()
    frames = frames_of(views()[:3], same)
    for frame in frames:
        frame["transform_matrix"] = np.eye(4).tolist()
    (same / "transforms.json").write_text(json.dumps(lens() | {"frames": frames}))
    with pytest.raises(DegenerateGeometryError, match="look the same way"):
        nerf(same, tmp_path / "out2", steps=5)
