"""A calibration meets the files of a pair: in the pixels that it describes, at their scale."""

import cv2
import numpy as np
import pytest
from PIL import Image

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.pipelines.stereo.pair_files import files_of_pair
from epipole.scene import StereoRig

W, H, SHIFT_PX = 240, 180, 12


def rig(covariance=None):
    camera = Camera("PINHOLE", W, H, [200.0, 200.0, 125.0, 80.0])
    return StereoRig(camera, camera, Rigid3(np.eye(3), np.array([-0.1, 0.0, 0.0])), covariance)


def pair(folder, rng, orientations, is_upright=False, scale=1.0):
    """A plane of texture; the orientation is added to stored pixels, or to those that it turns to upright ones."""
    texture = cv2.GaussianBlur(rng.integers(0, 255, (H, W + SHIFT_PX), np.uint8), (0, 0), 1.2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    paths = []
    for side, start, orientation in zip(("left", "right"), (0, SHIFT_PX), orientations):
        pixels = texture[:, start : start + W]
        if is_upright and orientation == 3:
            pixels = pixels[::-1, ::-1]
        pixels = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        exif = Image.Exif()
        exif[0x0112] = orientation
        paths.append(folder / f"{side}.png")
        Image.fromarray(np.ascontiguousarray(pixels)).save(paths[-1], exif=exif)
    return paths


@pytest.mark.parametrize("orientations", [(3, 3), (1, 3), (6, 6), (8, 1)])
def test_a_calibration_of_stored_pixels(tmp_path, rng, orientations):
    files = files_of_pair(*pair(tmp_path, rng, orientations), rig())
    assert files.orientations == (1, 1) and "stored pixels" in files.notes[0]
    left, right = files.read()
    np.testing.assert_array_equal(left[:, SHIFT_PX:], right[:, :-SHIFT_PX])


@pytest.mark.parametrize("orientations", [(3, 3), (1, 3), (1, 1)])
def test_a_calibration_of_upright_pixels(tmp_path, rng, orientations):
    files = files_of_pair(*pair(tmp_path, rng, orientations, is_upright=True), rig())
    assert files.orientations == (None, None) and files.notes == ()
    left, right = files.read()
    np.testing.assert_array_equal(left[:, SHIFT_PX:], right[:, :-SHIFT_PX])


def test_half_size_files(tmp_path, rng):
    covariance = np.diag(np.arange(1.0, 31.0))
    files = files_of_pair(*pair(tmp_path, rng, (1, 1), scale=0.5), rig(covariance))
    np.testing.assert_allclose(files.rig.left.params, [100.0, 100.0, 62.25, 39.75])
    expected = np.arange(1.0, 31.0)
    expected[[0, 1, 2, 3, 12, 13, 14, 15]] /= 4  # variances of pixels
    np.testing.assert_allclose(np.diag(files.rig.covariance), expected)
    assert "scaled to 120x90" in files.notes[0]


def test_rigs_are_scaled_by_one_factor():
    assert rig().scaled_to((W, H), (W, H)).left.width == W
    with pytest.raises(ConfigError, match="for images of 240x180, but the image is 240x100"):
        rig().scaled_to((W, H), (240, 100))
