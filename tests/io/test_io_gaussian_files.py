"""Gaussians in the formats that splats are passed on in: there and back within their rounding, real files, damaged ones."""

import gzip
import struct

import numpy as np
import pytest
from test_io_gaussian_ply import PARTS

from epipole.cameras import Camera
from epipole.errors import ConfigError, FileFormatError
from epipole.fields.splat.rasterizer import render
from epipole.geometry import Rigid3
from epipole.io.gaussians.files import read_gaussians, write_gaussians
from epipole.scene.gaussian_cloud import NUM_SH, GaussianCloud
from epipole.synthetic import look_at

CAMERA = Camera("PINHOLE", 48, 40, [45.0, 45.0, 23.5, 19.5])


def cloud_of(rng, count=300, num_sh=16):
    arrays = (
        *(rng.uniform(-1, 1, (count, 3)), rng.uniform(-3, -2, (count, 3)), rng.normal(size=(count, 4))),
        *(rng.uniform(-2, 2, count), 0.2 * rng.normal(size=(count, num_sh, 3))),
    )
    return GaussianCloud(*(array.astype(np.float32) for array in arrays))


@pytest.mark.parametrize("num_sh", NUM_SH)
@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz", "a.sog", "a.splat"])
def test_what_is_read_looks_like_what_was_written(rng, tmp_path, name, num_sh):
    cloud = cloud_of(rng, num_sh=num_sh)
    write_gaussians(tmp_path / name, cloud)
    found = read_gaussians(tmp_path / name)
    assert found.sh_degree == (0 if name.endswith(".splat") else cloud.sh_degree)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    wanted = cloud.sh[:, :1] if name.endswith(".splat") else cloud.sh
    whole = GaussianCloud(*(getattr(cloud, part) for part in PARTS[:4]), np.ascontiguousarray(wanted))
    for position in (look_at((0, -3, 1), (0, 0, 0)), look_at((2.5, 1, -1), (0, 0, 0))):
        one, other = (render(c, CAMERA, position).color for c in (whole, found))
        assert np.abs(one - other).mean() < 6e-3


def test_spz_is_turned_from_right_up_back(rng, tmp_path):
    cloud = cloud_of(rng, 40)
    write_gaussians(tmp_path / "a.spz", cloud)
    raw = gzip.decompress((tmp_path / "a.spz").read_bytes())
    first = (
        int.from_bytes(raw[16:19], "little", signed=True),
        int.from_bytes(raw[19:22], "little", signed=True),
    )
    assert np.array(first) / 4096 == pytest.approx([1, -1] * cloud.means_in_world[0, :2], abs=3e-4)


@pytest.mark.parametrize(("name", "count"), [("guitar.compressed.ply", 90_854), ("biker.spz", 152_746)])
def test_files_of_others(data_dir, name, count):
    cloud = read_gaussians(data_dir / "fields" / "splats" / name)
    assert len(cloud) == count
    middle = np.median(cloud.means_in_world.astype(float), axis=0)
    size = np.median(np.linalg.norm(cloud.means_in_world - middle, axis=1))
    position = look_at(middle + size * np.array([0, -0.5, -3]), middle)
    assert (
        0.05 < render(cloud, CAMERA, Rigid3(position.rotation, position.translation)).coverage.mean() < 0.95
    )


def test_an_unknown_ending_is_refused(rng, tmp_path):
    with pytest.raises(ConfigError, match=r"not to 'a.obj'"):
        write_gaussians(tmp_path / "a.obj", cloud_of(rng, 3))
    (tmp_path / "a.obj").write_bytes(b"v 0 0 0")
    with pytest.raises(FileFormatError, match="are read from"):
        read_gaussians(tmp_path / "a.obj")


def test_files_that_promise_too_much(rng, tmp_path):
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, 10, 0, 12, 0, 0)
    (tmp_path / "bomb.spz").write_bytes(gzip.compress(head + bytes(1 << 22)))
    with pytest.raises(FileFormatError, match="unpacks to more"):
        read_gaussians(tmp_path / "bomb.spz")
    (tmp_path / "many.spz").write_bytes(
        gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 2**31, 0, 12, 0, 0))
    )
    with pytest.raises(FileFormatError, match="2147483648 Gaussians are more than"):
        read_gaussians(tmp_path / "many.spz")
    write_gaussians(tmp_path / "a.compressed.ply", cloud_of(rng, 300, 1))
    data = (tmp_path / "a.compressed.ply").read_bytes().replace(b"vertex 300", b"vertex 3000000")
    (tmp_path / "a.compressed.ply").write_bytes(data)
    with pytest.raises(FileFormatError, match="is truncated: it should contain"):
        read_gaussians(tmp_path / "a.compressed.ply")
    (tmp_path / "a.splat").write_bytes(bytes(33))
    with pytest.raises(FileFormatError, match="not a multiple of 32"):
        read_gaussians(tmp_path / "a.splat")
