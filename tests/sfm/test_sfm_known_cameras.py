"""A known camera is that of a sensor: images that EXIF turns differently get it turned, smaller ones scaled."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from epipole.cameras import Camera
from epipole.cameras.image_fit import rotated_camera
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.io.calibration.files import CalibrationFile, write_calibration
from epipole.io.images.photographs import PhotographHeader
from epipole.pipelines.sfm.cameras import group_cameras
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.matching.database_stage import _refuse_rotated

pytestmark = pytest.mark.usefixtures("unchecked")

LENS = Camera("OPENCV", 480, 320, [400.0, 402.0, 250.0, 150.0, -0.1, 0.02, 1e-3, -2e-3])


def header(orientation: int = 1, size: tuple[int, int] = (480, 320)) -> PhotographHeader:
    """Of an image whose stored pixels have this size."""
    width, height = size if orientation < 5 else size[::-1]
    return PhotographHeader(width, height, orientation, "", "", None, None, None, None)


def grouped(headers, **options):
    return group_cameras({f"{n}.jpg": h for n, h in enumerate(headers)}, ReconstructConfig(**options))


@pytest.fixture
def calibration(tmp_path):
    path = tmp_path / "calibration.json"
    write_calibration(path, CalibrationFile((LENS,), Rigid3.identity(1)))
    return path


@pytest.mark.parametrize("rotated", [2, 3, 4, 6, 8])
def test_every_second_image_turned(calibration, rotated):
    found = grouped([header(), header(rotated)] * 3, calibration=calibration)
    assert len(found.cameras) == 2 and found.cameras.is_constant.all()
    for image, orientation in enumerate([1, rotated] * 3):
        expected = rotated_camera(LENS, orientation)
        camera = found.cameras[int(found.camera_of_image[image])]
        assert (camera.width, camera.height) == (expected.width, expected.height)
        np.testing.assert_allclose(camera.params, expected.params)
    assert "the stored pixels" in found.notes[0]


@pytest.mark.parametrize("rotated", [3, 6])
def test_the_same_of_numbers(rotated):
    found = grouped([header(), header(rotated)], camera_params="400,402,250.5,150.5")
    pinhole = Camera("PINHOLE", 480, 320, LENS.params[:4])
    for camera, orientation in zip((found.cameras[int(c)] for c in found.camera_of_image), (1, rotated)):
        np.testing.assert_allclose(camera.params, rotated_camera(pinhole, orientation).params)


def test_half_size_images(calibration):
    found = grouped([header(size=(240, 160))] * 2, calibration=calibration)
    np.testing.assert_allclose(found.cameras[0].params, LENS.scaled_to(240, 160).params)
    assert found.notes == (f"calibration {calibration} is for images of 480x320 and was scaled to 240x160",)


def test_what_does_not_fit_is_refused_with_both_sizes(calibration):
    with pytest.raises(ConfigError, match="for images of 480x320, but these are 320x480"):
        grouped([header(size=(320, 480))], calibration=calibration)
    with pytest.raises(ConfigError, match="for images of 480x320, but these are 480x300"):
        grouped([header(), header(size=(480, 300))], calibration=calibration)


def test_images_that_are_not_turned_keep_the_camera_as_it_is(calibration):
    found = grouped([header()] * 3, calibration=calibration)
    assert found.notes == () and len(found.cameras) == 1
    np.testing.assert_array_equal(found.cameras[0].params, LENS.params)
    centered = replace(LENS, params=np.array([400.0, 402.0, 239.5, 159.5, 0.0, 0.0, 0.0, 0.0]))
    write_calibration(calibration, CalibrationFile((centered,), Rigid3.identity(1)))
    assert grouped([header(3)] * 3, calibration=calibration).notes == ()  # the same either way


@pytest.mark.parametrize(("orientation", "is_refused"), [(1, False), (3, True), (6, False)])
def test_a_database_may_be_of_stored_pixels(tmp_path, orientation, is_refused):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(tmp_path / "a.png", exif=exif)
    images = SimpleNamespace(folder=tmp_path, names=("a.png",))
    if not is_refused:
        _refuse_rotated(tmp_path / "given.db", images)
        return
    with pytest.raises(
        ConfigError, match=r"a.png has EXIF orientation 3, so the keypoints in .*given.db may refer"
    ):
        _refuse_rotated(tmp_path / "given.db", images)
