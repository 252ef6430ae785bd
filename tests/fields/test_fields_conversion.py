"""`epipole.convert` of Gaussians: unpacked SOG, and what a format cannot hold."""

import zipfile
from dataclasses import replace

import numpy as np
import pytest
from fields_scenes import scene as small_cloud

from epipole import convert
from epipole.io.gaussians.files import read_gaussians, write_gaussians
from epipole.pipelines.fields.scene import is_mine, scene

UTM = np.array([500_000.0, 5_200_000.0, 300.0])


@pytest.fixture
def unpacked(tmp_path):
    """The folder of an unpacked SOG."""
    write_gaussians(tmp_path / "a.sog", small_cloud())
    folder = tmp_path / "unpacked"
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(folder)
    return folder


def test_an_unpacked_sog_is_shown_and_converted(unpacked, tmp_path):
    expected = read_gaussians(tmp_path / "a.sog")
    for path in (unpacked, unpacked / "meta.json"):
        assert is_mine(path)
        np.testing.assert_array_equal(scene(path).gaussians.means_in_world, expected.means_in_world)
        convert(path, tmp_path / "b.ply")
        np.testing.assert_array_equal(read_gaussians(tmp_path / "b.ply").sh, expected.sh)


def test_another_meta_json_is_not_taken_for_one(tmp_path):
    (tmp_path / "meta.json").write_text('{"version": 1, "frames": []}')
    assert not is_mine(tmp_path / "meta.json") and not is_mine(tmp_path)


def test_what_a_format_cannot_hold_is_said(tmp_path):
    sh = np.zeros((len(small_cloud()), 4, 3), np.float32)
    write_gaussians(tmp_path / "a.ply", replace(small_cloud(), sh=sh, origin_in_world=UTM))
    assert convert(tmp_path / "a.ply", tmp_path / "a.sog").losses == ()
    (words,) = convert(tmp_path / "a.ply", tmp_path / "a.spz").losses
    assert "500000.0 5200000.0 300.0" in words
    assert any("degree 1" in words for words in convert(tmp_path / "a.ply", tmp_path / "a.splat").losses)
