"""Gaussians in PLY files, there and back; and files that are damaged."""

import numpy as np
import pytest

from epipole.errors import FileFormatError
from epipole.io.gaussians.ply import read_gaussian_ply, write_gaussian_ply
from epipole.scene.gaussian_cloud import NUM_SH, GaussianCloud

PARTS = ("means_in_world", "log_scales", "quats_wxyz", "opacity_logits", "sh")


def cloud_of(rng, count, num_sh):
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, num_sh, 3))
    return GaussianCloud(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))


@pytest.mark.parametrize("num_sh", NUM_SH)
def test_there_and_back(rng, tmp_path, num_sh):
    cloud = cloud_of(rng, 17, num_sh)
    write_gaussian_ply(tmp_path / "a.ply", cloud)
    found = read_gaussian_ply(tmp_path / "a.ply")
    for name in PARTS:
        np.testing.assert_array_equal(getattr(found, name), getattr(cloud, name))


def test_the_layout_is_that_of_the_paper(rng, tmp_path):
    cloud = cloud_of(rng, 2, 4)
    write_gaussian_ply(tmp_path / "a.ply", cloud)
    data = (tmp_path / "a.ply").read_bytes()
    header, _, body = data.partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property")]
    row = dict(zip(names, np.frombuffer(body, "<f4").reshape(2, -1)[1]))
    assert names[:3] == ["x", "y", "z"] and len(body) == 4 * 2 * len(names)
    assert row["f_rest_0"] == cloud.sh[1, 1, 0] and row["f_rest_3"] == cloud.sh[1, 1, 1]
    assert row["rot_0"] == cloud.quats_wxyz[1, 0] and row["opacity"] == cloud.opacity_logits[1]


def test_gaussians_that_are_not_finite_are_left_out(rng, tmp_path):
    cloud = cloud_of(rng, 9, 1)
    cloud.means_in_world[2, 1], cloud.sh[4, 0, 0], cloud.quats_wxyz[6] = np.nan, np.inf, 0.0
    write_gaussian_ply(tmp_path / "a.ply", cloud)
    found = read_gaussian_ply(tmp_path / "a.ply")
    assert len(found) == 7 and found.quats_wxyz[4].tolist() == [1, 0, 0, 0]
    cloud.means_in_world[:] = np.nan
    write_gaussian_ply(tmp_path / "b.ply", cloud)
    with pytest.raises(FileFormatError, match="none of its 9"):
        read_gaussian_ply(tmp_path / "b.ply")


def test_damaged_files_are_refused(rng, tmp_path):
    write_gaussian_ply(tmp_path / "a.ply", cloud_of(rng, 9, 4))
    data = (tmp_path / "a.ply").read_bytes()
    wrong = {
        "cut.ply": (data[:-10], "ends|room|short|cut"),
        "more.ply": (data.replace(b"vertex 9", b"vertex 99999999999"), "vertices"),
        "none.ply": (data.replace(b"opacity", b"opaquer"), "no opacity"),
        "degree.ply": (data.replace(b"f_rest_8", b"f_else_8"), "not match any degree"),
        "text.ply": (b"hello", "not a PLY"),
    }
    for name, (content, words) in wrong.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError, match=words):
            read_gaussian_ply(tmp_path / name)


def test_a_file_of_none_and_a_rotation_that_is_no_number(rng, tmp_path):
    cloud = cloud_of(rng, 5, 4)
    cloud.quats_wxyz[1, 2] = np.nan
    write_gaussian_ply(tmp_path / "a.ply", cloud)
    assert len(read_gaussian_ply(tmp_path / "a.ply")) == 4
    write_gaussian_ply(tmp_path / "a.ply", cloud.rows(np.zeros(0, np.int64)))
    with pytest.raises(FileFormatError, match="no Gaussians in it"):
        read_gaussian_ply(tmp_path / "a.ply")
