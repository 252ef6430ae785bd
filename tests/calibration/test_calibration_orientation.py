"""Board images of one sensor that EXIF turns differently are read as they are stored."""

import numpy as np
import pytest
from PIL import Image

from board_pictures import board_pictures
from epipole.pipelines.calibration.run import _common_orientation, calibrate

CROPPED_PX = 60


def tagged(path, pixels, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(path, exif=exif)


def test_the_principal_point_is_that_of_the_sensor(tmp_path):
    images = board_pictures(tmp_path / "made", count=6)["images"]
    (tmp_path / "tagged").mkdir()
    for n, gray in enumerate(images):  # cropped, so that the principal point is off the middle
        cropped = np.ascontiguousarray(gray[:, CROPPED_PX:])
        tagged(tmp_path / "tagged" / f"{n}.png", cropped, (1, 3, 6)[n % 3])
    found = calibrate(tmp_path / "tagged", tmp_path / "out", columns=9, rows=6)
    camera = found.calibration.cameras[0]
    assert (camera.width, camera.height) == (640 - CROPPED_PX, 480)
    np.testing.assert_allclose(camera.K[:2, 2], [319.5 - CROPPED_PX, 239.5], atol=2.0)
    assert found.calibration.rms_px < 0.3
    assert any("describes their stored pixels" in words for words in found.problems.values())


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        (((1, (40, 30)), (1, (40, 30))), None),
        (((6, (40, 30)), (6, (40, 30))), None),  # all alike: upright, as ever
        (((1, (40, 30)), (6, (40, 30))), 1),
        (((1, (40, 30)), (3, (40, 30))), 1),
        (((1, (30, 40)), (6, (40, 30))), None),  # one was turned before it was stored
    ],
)
def test_which_pixels_are_read(tmp_path, kinds, expected):
    paths = [tmp_path / f"{n}.png" for n in range(len(kinds))]
    for path, (orientation, (width, height)) in zip(paths, kinds):
        tagged(path, np.zeros((height, width), np.uint8), orientation)
    orientation, note = _common_orientation(paths)
    assert orientation == expected and bool(note) == (expected == 1)
