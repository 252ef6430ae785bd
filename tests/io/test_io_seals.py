"""Seals: a sealed file reads as before, and any change of it is noticed."""

import gzip
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from epipole.io.gaussians.files import read_gaussians, write_gaussians
from epipole.io.images.video_files import write_video
from epipole.io.meshes.ply import read_points_ply, write_points_ply
from epipole.io.meshes.usd_cameras import write_usd_cameras
from epipole.io.seals import add_seal, sealed_by
from epipole.scene.gaussian_cloud import GaussianCloud
from io_models import mappable_model


def cloud() -> GaussianCloud:
    rng = np.random.default_rng(0)
    shapes = ((9, 3), (9, 3), (9, 4), (9,), (9, 1, 3))
    return GaussianCloud(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))


def page(path: Path) -> None:
    path.write_text("<!DOCTYPE html>\n<title>x</title>" + "y" * 100_000)


def points(path: Path) -> None:
    write_points_ply(path, np.eye(3), np.zeros((3, 3), np.uint8))


def video(path: Path) -> None:
    write_video(path, [np.full((48, 64, 3), 90, np.uint8)] * 3, 30.0)


def stage(path: Path) -> None:
    write_usd_cameras(path, mappable_model())


MAKERS: dict[str, Callable[[Path], None]] = {
    "a.html": page,
    "a.mp4": video,
    "points.ply": points,
    "a.usda": stage,
    "a.usdz": stage,
    **{
        name: lambda path: write_gaussians(path, cloud())
        for name in ("a.ply", "a.compressed.ply", "a.spz", "a.sog")
    },
}


@pytest.mark.parametrize("name", MAKERS)
def test_any_change_breaks_the_seal(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    MAKERS[name](path)
    assert sealed_by(path) is None
    add_seal(path, "render")
    content = path.read_bytes()
    assert sealed_by(path) == "render"
    for at in {*range(0, len(content), max(1, len(content) // 23)), len(content) - 1}:
        path.write_bytes(content[:at] + bytes([content[at] ^ 4]) + content[at + 1 :])
        assert sealed_by(path) is None, at
    for changed in (
        content[:-1],
        content + b"x",
        content.replace(b"render", b"rende_"),
        content[:20] + content,
        b"",
    ):
        path.write_bytes(changed)
        assert sealed_by(path) is None


def test_sealed_files_read_as_before(tmp_path: Path) -> None:
    for name in ("a.ply", "a.compressed.ply", "a.spz", "a.sog"):
        write_gaussians(tmp_path / name, cloud())
        before = read_gaussians(tmp_path / name)
        add_seal(tmp_path / name, "convert")
        after = read_gaussians(tmp_path / name)
        assert np.array_equal(before.means_in_world, after.means_in_world) and np.array_equal(
            before.sh, after.sh
        )
    points(tmp_path / "points.ply")
    add_seal(tmp_path / "points.ply", "convert")
    assert np.array_equal(read_points_ply(tmp_path / "points.ply").xyz, np.eye(3))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert archive.testzip() is None
    assert len(gzip.decompress((tmp_path / "a.spz").read_bytes())) > 9


@pytest.mark.parametrize(
    "content", [b"", b"x", b"\0" * 300, b"PK\x05\x06" + b"\0" * 18, b"\x1f\x8b\x08\x04" + b"\0" * 90]
)
def test_what_has_no_room_stays_as_it_is(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(content)
    add_seal(path, "convert")
    assert path.read_bytes() == content and sealed_by(path) is None
