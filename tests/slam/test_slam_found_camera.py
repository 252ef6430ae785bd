"""A camera that nothing tells: found from the images, taken from a map, or refused with the reason."""

import cv2
import numpy as np
import pytest
from slam_rides import CAMERA, MONO, ride, tracked

from epipole.errors import ConfigError, FileFormatError
from epipole.io.calibration.files import read_calibration
from epipole.metrics import absolute_error
from epipole.pipelines.slam.output.map_file import camera_of_map, write_slam_map
from epipole.pipelines.slam.run import slam as run_slam

COUNT = 24
"""Frames of the ride."""


def folder_of(path, images):
    path.mkdir()
    for n, image in enumerate(images):
        cv2.imwrite(str(path / f"{n:04d}.png"), image)
    return path


@pytest.mark.usefixtures("unchecked")
def test_it_is_found_from_the_pictures_and_written(tmp_path):
    images = folder_of(tmp_path / "pictures", ride().left[:COUNT])
    out = tmp_path / "out"
    result = run_slam(images, out, fps=10.0)
    assert any("the camera intrinsics are unknown: they were estimated from" in w for w in result.warnings)
    found = read_calibration(out / "camera.json").cameras[0]
    assert found.focal_px == pytest.approx(CAMERA.focal_px, rel=0.01)
    assert result.summary["camera_found"]["images"] >= 8
    assert result.summary["num_localized"] == COUNT
    assert (
        absolute_error(result.trajectory.world_from_body, ride().truth()[:COUNT], "similarity").position.rmse
        < 0.03
    )
    again = run_slam(images, tmp_path / "again", fps=10.0, calibration=out / "camera.json")
    np.testing.assert_allclose(
        again.trajectory.world_from_body.translation, result.trajectory.world_from_body.translation, atol=1e-9
    )


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("kind", "count", "words"),
    [("arc", 4, "4 images are too few"), ("rest", 12, "the camera intrinsics are unknown")],
)
def test_frames_that_do_not_tell_it_are_refused(kind, count, words, tmp_path):
    images = folder_of(tmp_path / "pictures", ride(kind, count).left[:count])
    with pytest.raises(ConfigError, match=rf"{words}.* pass camera_params"):
        run_slam(images, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_is_said_before_anything_is_sought(tmp_path):
    images = folder_of(tmp_path / "pictures", ride().left[:4])
    for options, words in (
        ({"sensor": "stereo"}, "no calibrated second camera"),
        ({"topics": "/a"}, "topics is for ROS bags"),
    ):
        with pytest.raises(ConfigError, match=words):
            run_slam(images, tmp_path / "out", **options)
    with pytest.raises(FileFormatError):
        run_slam(images, tmp_path / "out", truth=tmp_path / "none.txt")


def test_a_map_tells_the_camera(tmp_path):
    slam, _ = tracked(ride().frames("mono"), MONO)
    names = [f"{k.number:04d}.png" for k in slam.map.keyframes]
    write_slam_map(tmp_path / "map.npz", slam.map, names, MONO)
    assert camera_of_map(tmp_path / "map.npz").model == CAMERA.model
    images = folder_of(tmp_path / "pictures", ride().left[:6])
    result = run_slam(images, tmp_path / "out", map=tmp_path / "map.npz", localize=True)
    assert any("those of the known map are used" in w for w in result.warnings)
    assert result.summary["num_localized"] >= 5
