"""Gaussians of all versions and kinds of files, by their contents."""

import gzip
import multiprocessing
import os
import struct
from dataclasses import replace

import numpy as np
import pytest

from epipole.errors import ConfigError, FileFormatError
from epipole.io.gaussians.files import read_gaussians, write_gaussians
from epipole.scene.gaussian_cloud import GaussianCloud

UTM = np.array([500_000.0, 5_200_000.0, 300.0])


def cloud_of(count=300, num_sh=4):
    rng = np.random.default_rng(0)
    arrays = (
        *(rng.uniform(-1, 1, (count, 3)), rng.uniform(-3, -2, (count, 3)), rng.normal(size=(count, 4))),
        *(rng.uniform(-2, 2, count), 0.2 * rng.normal(size=(count, num_sh, 3))),
    )
    return GaussianCloud(*(array.astype(np.float32) for array in arrays))


def spz_of_version_1():
    """Two Gaussians with positions in half precision."""
    head = struct.pack("<4sIIBBBB", b"NGSP", 1, 2, 0, 0, 0, 0)
    means = np.array([[0.5, -2.0, 3.0], [100.0, 0.25, -1.0]], "<f2").tobytes()
    alphas, colors = bytes([255, 128]), bytes([127, 200, 10, 128, 128, 128])
    scales, rotations = bytes([160, 144, 128] * 2), bytes([127, 127, 127, 255, 127, 127])
    return gzip.compress(head + means + alphas + colors + scales + rotations)


def test_spz_of_version_1(tmp_path):
    (tmp_path / "a.spz").write_bytes(spz_of_version_1())
    cloud = read_gaussians(tmp_path / "a.spz")
    np.testing.assert_array_equal(cloud.means_in_world, [[0.5, 2.0, -3.0], [100.0, -0.25, 1.0]])
    np.testing.assert_array_equal(cloud.log_scales, [[0.0, -1.0, -2.0]] * 2)
    np.testing.assert_allclose(np.abs(cloud.quats_wxyz), [[1, 0, 0, 0], [0, 1, 0, 0]], atol=0.01)
    assert cloud.opacity_logits[0] == 15.0 and abs(cloud.opacity_logits[1]) < 0.01


@pytest.mark.parametrize("version", [0, 5])
def test_other_versions_are_refused(tmp_path, version):
    data = bytearray(gzip.decompress(spz_of_version_1()))
    data[4] = version
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(data)))
    with pytest.raises(FileFormatError, match=f"unsupported SPZ version {version}"):
        read_gaussians(tmp_path / "a.spz")


def test_versions_of_one_scene_agree(data_dir):
    """Version 2 was written by another program, with other axes and colors."""
    third, fourth, splat = (
        read_gaussians(data_dir / "faults" / name)
        for name in ("minimal-v3.spz", "minimal-v4.spz", "minimal.splat")
    )
    for cloud in (third, fourth):
        assert len(cloud) == 4
        np.testing.assert_allclose(cloud.means_in_world, splat.means_in_world, atol=1e-6)
        np.testing.assert_allclose(cloud.log_scales, splat.log_scales, atol=0.04)
        np.testing.assert_allclose(cloud.opacity_logits, splat.opacity_logits, atol=1e-5)
        np.testing.assert_allclose(cloud.sh, splat.sh, atol=0.02)
    assert len(read_gaussians(data_dir / "faults" / "minimal-v2.spz")) == 4


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz", "a.sog", "a.splat"])
def test_opacities_of_0_and_1_and_flat_gaussians_stay(tmp_path, name):
    logits = np.concatenate([[np.inf, -np.inf, 40.0], np.zeros(297)]).astype(np.float32)
    write_gaussians(tmp_path / name, replace(cloud_of(), opacity_logits=logits))
    found = read_gaussians(tmp_path / name)
    assert len(found) == 300
    opacity = np.sort(1.0 / (1.0 + np.exp(-found.opacity_logits.astype(float))))
    assert opacity[0] < 1e-6 and opacity[-2] > 1.0 - 1e-6
    flat = cloud_of()
    flat.log_scales[:, 2] = -np.inf
    write_gaussians(tmp_path / f"flat{name[1:]}", flat)
    assert len(read_gaussians(tmp_path / f"flat{name[1:]}")) == 300


@pytest.mark.parametrize("written", ["a.ply", "a.compressed.ply", "a.spz", "a.sog"])
@pytest.mark.parametrize("named", ["b.ply", "b.spz", "b.sog", "b.splat"])
def test_the_content_decides(tmp_path, written, named):
    write_gaussians(tmp_path / written, cloud_of())
    expected = read_gaussians(tmp_path / written)
    (tmp_path / written).rename(tmp_path / named)
    found = read_gaussians(tmp_path / named)
    np.testing.assert_array_equal(found.means_in_world, expected.means_in_world)


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.sog"])
def test_an_origin_is_written_and_read_back(tmp_path, name):
    write_gaussians(tmp_path / name, replace(cloud_of(), origin_in_world=UTM))
    found = read_gaussians(tmp_path / name)
    np.testing.assert_array_equal(found.origin_in_world, UTM)
    near = np.sort(found.centers_in_world - UTM, axis=0)
    np.testing.assert_allclose(near, np.sort(cloud_of().means_in_world, axis=0), atol=2e-3)


def test_spz_of_a_wide_scene_keeps_its_far_positions(tmp_path):
    cloud = cloud_of()
    wide = replace(cloud, means_in_world=cloud.means_in_world * np.float32(30_000.0))
    write_gaussians(tmp_path / "a.spz", wide)
    np.testing.assert_allclose(
        read_gaussians(tmp_path / "a.spz").means_in_world, wide.means_in_world, atol=0.01
    )
    with pytest.raises(ConfigError, match="cannot store the coordinate"):
        write_gaussians(
            tmp_path / "b.spz", replace(cloud, means_in_world=cloud.means_in_world * np.float32(1e9))
        )


def test_compressed_plys_of_early_writers_have_no_ranges_of_color(tmp_path):
    write_gaussians(tmp_path / "a.compressed.ply", cloud_of(10, 1))
    head, body = (tmp_path / "a.compressed.ply").read_bytes().split(b"end_header\n", 1)
    for name in (b"min_r", b"min_g", b"min_b", b"max_r", b"max_g", b"max_b"):
        head = head.replace(b"property float " + name + b"\n", b"")
    (tmp_path / "b.ply").write_bytes(head + b"end_header\n" + body[:48] + body[72:])
    found = read_gaussians(tmp_path / "b.ply")
    colors = 0.5 + 0.28209479 * found.sh[:, 0]
    assert colors.min() == pytest.approx(0.0, abs=1e-6) and colors.max() == pytest.approx(1.0, abs=1e-6)


def _reads(folder):
    os._exit(0 if all(len(read_gaussians(path)) == 300 for path in folder.iterdir()) else 1)


def test_a_forked_child_without_a_home_can_read(tmp_path, monkeypatch):
    for name in ("a.compressed.ply", "a.spz"):
        write_gaussians(tmp_path / name, cloud_of())
    monkeypatch.setenv("HOME", "/nonexistent")
    child = multiprocessing.get_context("fork").Process(target=_reads, args=(tmp_path,))
    child.start()
    child.join(60)
    assert child.exitcode == 0
