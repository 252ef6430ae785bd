"""`epipole.nerf`: from cameras and images to a field of either kind, held-out images and figures; its file; and drawing it."""

import json
import re

import numpy as np
import pytest
from fields_scenes import CAMERA, camera, frames_of, views

from epipole import nerf, render
from epipole.errors import ConfigError, DegenerateGeometryError, FileFormatError
from epipole.fields.nerf.hash_files import HashContents, write_hash
from epipole.fields.nerf.voxel_field import gaussians_of
from epipole.fields.nerf.voxel_files import GridContents, read_grid, write_grid
from epipole.fields.photometric import psnr
from epipole.fields.splat.rasterizer import render as draw
from epipole.io.images.photographs import read_rgb
from epipole.pipelines.fields.kinds import KINDS, kind_in, read_neural, read_voxels
from epipole.pipelines.fields.scene import is_mine, seen_gaussians
from epipole.pipelines.viewing.run import write_page
from whole import IS_WHOLE, in_whole_run

pytestmark = pytest.mark.usefixtures("small_hash", "unchecked_module")

STEPS = 80
LEAST_PSNR = {"grid": 20, "hash": 18}
MOST_OFF = {"grid": 5e-3, "hash": 2e-2}
"""Of a pixel, after the rounding of a field's file: the network adds up what its tables lose."""
DARKEST = {"grid": 0.7, "hash": 0.8}
MOST_LEVELS = {"grid": 2, "hash": 4}


@pytest.fixture(scope="module", params=["hash"] + IS_WHOLE * ["grid"])
def result(request, source, tmp_path_factory):
    return nerf(
        source, tmp_path_factory.mktemp("nerf") / "out", test_every=7, steps=STEPS, kind=request.param
    )


def kind_of(result):
    return KINDS[result.summary["kind"]]


def test_results_are_written(result):
    metrics = json.loads((result.out / "metrics.json").read_text())
    assert metrics["num_train"] == 12 and metrics["num_test"] == 2 and metrics["steps"] == STEPS
    assert metrics["psnr"] > LEAST_PSNR[metrics["kind"]] and metrics["background"] == "white"
    assert sorted(path.name for path in (result.out / "test").iterdir()) == ["images_00.png", "images_07.png"]
    kind = KINDS[metrics["kind"]]
    assert metrics[kind.count] > 1000 and kind_in(result.out) == (kind, result.out / kind.file)
    if metrics["kind"] == "grid":
        assert (
            metrics["num_voxels"] == len(result.field.values) == len(kind.read(result.out / kind.file).values)
        )


@pytest.mark.parametrize("kind", list(KINDS) if IS_WHOLE else ["hash"])
def test_what_was_interrupted_goes_on_with_the_same_bits(source, tmp_path, kind):
    def stop(progress):
        if progress.stage == "train" and progress.done > 55:
            raise KeyboardInterrupt

    options = {"test_every": 7, "steps": 12, "kind": kind}
    whole = nerf(source, tmp_path / "whole", **options)
    first = nerf(source, tmp_path / "out", progress=stop, **options)
    assert first.summary["interrupted"] and (tmp_path / "out" / "checkpoint.npz").is_file()
    assert 6 < first.summary["steps"] < 12
    found = nerf(source, tmp_path / "out", **options)
    assert f"continued an earlier run at step {first.summary['steps']}" in found.warnings[0]
    file = KINDS[kind].file
    assert (found.out / file).read_bytes() == (whole.out / file).read_bytes()
    assert not (tmp_path / "out" / "checkpoint.npz").exists()


def test_what_is_read_draws_the_same(result):
    kind, position = kind_of(result), views()[3].cam_from_world
    found = kind.read(result.out / kind.file)
    one, other = (kind.render(field, CAMERA, position, np.ones(3))[0] for field in (result.field, found))
    name = result.summary["kind"]
    assert np.abs(one - other).max() < MOST_OFF[name] and np.abs(one - other).mean() < 1e-3
    assert one.min() < DARKEST[name]


def test_the_command_draws_it(result, source, tmp_path):
    render(result.out, tmp_path / "out", cameras=source / "transforms.json")
    found = read_rgb(tmp_path / "out" / "07.png")
    assert (
        np.abs(found.astype(int) - read_rgb(result.out / "test" / "images_07.png")).max()
        <= (MOST_LEVELS[result.summary["kind"]])
    )
    render(result.out / kind_of(result).file, tmp_path / "round", frames=2, width=32)
    assert read_rgb(tmp_path / "round" / "00000.png").min() < 200


def test_its_gaussians_look_like_it(result):
    kind = kind_of(result)
    assert is_mine(result.out) and is_mine(result.out / kind.file) and not is_mine(result.out / "test")
    cloud, position = seen_gaussians(result.out)[0], views()[3].cam_from_world
    assert cloud.sh_degree == 1
    one = draw(cloud, CAMERA, position).over(np.ones(3, np.float32))
    other = np.clip(kind.render(result.field, CAMERA, position, np.ones(3))[0], 0, 1)
    assert psnr(one, other) > psnr(np.ones_like(other), other) + 3.0


@in_whole_run
@pytest.mark.parametrize("result", ["grid"], indirect=True)
def test_so_many_gaussians_are_made_and_none_of_what_is_empty(result):
    voxels = kind_of(result).voxels(result.field)
    assert len(gaussians_of(voxels, 50)) == 50
    with pytest.raises(DegenerateGeometryError, match="empty"):
        gaussians_of(voxels._replace(values=np.zeros_like(voxels.values)), 50)


@in_whole_run
@pytest.mark.parametrize(
    "result", ["grid"], indirect=True
)  # a neural field is first made a grid, which takes long
def test_its_gaussians_are_shared_with_its_cameras(result, tmp_path):
    done = write_page(result.out, tmp_path / "page.html", 500_000)
    count = f"{len(seen_gaussians(result.out)[0]):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    assert done.shown.startswith(f"{count} Gaussians that coarsely approximate a radiance field")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "as trained" in page and "next-camera" in page
    given = json.loads(re.search(r'id="space-data">(.*?)</script>', page)[1])
    assert len(given["cameras"]["names"]) == len(views()) - 2


@in_whole_run
def test_another_kind_takes_the_place_of_the_first(source, tmp_path):
    for kind in ("hash", "grid"):
        found = nerf(source, tmp_path / "out", steps=2, kind=kind)
        assert kind_in(found.out) == (KINDS[kind], found.out / KINDS[kind].file)
        assert len(list(found.out.glob("*.npz"))) == 1


def test_wrong_files(tmp_path, rng):
    cells = rng.uniform(size=(3, 4, 5)) < 0.5
    write_grid(tmp_path / "a.npz", GridContents(cells, np.zeros((7, 13), np.float32), np.zeros(3), 0.1, 0.2))
    assert (read_grid(tmp_path / "a.npz").cells == cells).all()
    with pytest.raises(FileFormatError, match="7 rows of values"):
        read_voxels(tmp_path / "a.npz")
    (tmp_path / "b.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:-30])
    with pytest.raises(FileFormatError, match="or damaged"):
        read_grid(tmp_path / "b.npz")
    np.savez(
        tmp_path / "c.npz",
        shape=np.array([10**9] * 3, np.int32),
        place=np.ones(5),
        cells=np.zeros(1, np.uint8),
        values=np.zeros((1, 13), np.float16),
    )
    with pytest.raises(FileFormatError, match="shape must be from"):
        read_grid(tmp_path / "c.npz")


def test_wrong_neural_files(tmp_path, rng):
    layers = [(8, 24), (24, 16), (32, 24), (24, 24), (24, 3)]
    good = {
        "occupied": np.ones((3, 4, 5), bool),
        "low": np.zeros(3),
        "size": 0.5,
        "cells": np.array([4, 9]),
        "tables": rng.normal(size=(2, 64, 4)).astype(np.float32),
        "weights": tuple(rng.normal(size=shape).astype(np.float32) for shape in layers),
    }
    write_hash(tmp_path / "hash.npz", HashContents(**good))
    field = read_neural(tmp_path / "hash.npz")
    np.testing.assert_allclose(field.tables, good["tables"], atol=3e-3)
    for change, words in (
        ({"size": 0.0}, "not positive"),
        (
            {"cells": np.array([4]), "tables": good["tables"][:1]},
            "shapes of the network's layers do not match",
        ),
        ({"cells": np.array([4, 0])}, "levels must be from"),
        ({"tables": rng.normal(size=(2, 63, 4)).astype(np.float32)}, "not a power of two"),
        ({"weights": good["weights"][:1] * 5}, "shapes of the network's layers do not match"),
        ({"tables": np.full((2, 64, 4), np.nan, np.float32)}, "tables must be finite"),
    ):
        write_hash(tmp_path / "bad.npz", HashContents(**(good | change)))
        with pytest.raises(FileFormatError, match=words):
            read_neural(tmp_path / "bad.npz")


def test_what_cannot_be_trained(source, tmp_path):
    with pytest.raises(ConfigError, match="seed"):
        nerf(source, tmp_path / "out", seed=-1)
    with pytest.raises(FileFormatError, match="it does not exist"):
        nerf(tmp_path / "none", tmp_path / "out")
    same = tmp_path / "same"
    same.mkdir()
    frames = frames_of(views()[:3], same)
    for frame in frames:
        frame["transform_matrix"] = np.eye(4).tolist()
    (same / "transforms.json").write_text(json.dumps(camera() | {"frames": frames}))
    with pytest.raises(DegenerateGeometryError, match="look in the same direction"):
        nerf(same, tmp_path / "out2", steps=5)
