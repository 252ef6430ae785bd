"""Frames from images of any type, and from raw pairs."""

import numpy as np
import pytest
from slam_rides import BASELINE, CAMERA, ride

from epipole.cameras import Camera, CameraModel
from epipole.disparity_search.rectification import rectify
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.image import gray_image
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.slam import Slam
from epipole.scene import StereoRig

pytestmark = pytest.mark.usefixtures("unchecked")
FLAT = StereoRig(CAMERA, CAMERA, Rigid3(np.eye(3), np.array([-BASELINE, 0.0, 0.0])))
LENS = Camera(CameraModel.OPENCV, 320, 240, np.array([260.0, 262, 160, 118, -0.1, 0.02, 0.0, 0.001]))
RAW = StereoRig(LENS, LENS, Rigid3.exp(np.array([-0.12, 0.002, 0.001, 0.01, -0.02, 0.005])))


@pytest.fixture
def gray(rng):
    return rng.integers(0, 256, (24, 32), np.uint8)


def test_the_same_image_of_every_type_is_the_same_gray_image(gray):
    assert gray_image(gray) is gray
    for image in (
        gray[..., None],
        np.repeat(gray[..., None], 3, axis=2),
        np.repeat(gray[..., None], 4, axis=2),
        257 * gray.astype(np.uint16),
        gray / 255.0,
        (gray / 255.0).astype(np.float32),
        np.repeat((257 * gray.astype(np.uint16))[..., None], 3, axis=2),
    ):
        found = gray_image(image)
        assert found.dtype == np.uint8
        np.testing.assert_array_equal(found, gray)
    twelve_bits = np.array([[0, 4095, 4096, 65535, 2048]], np.uint16)
    np.testing.assert_array_equal(gray_image(twelve_bits, 4095.0), [[0, 255, 255, 255, 128]])
    np.testing.assert_array_equal(gray_image(np.array([[2.0, 1.0]])), [[255, 255]])


def test_colors_are_weighed_as_red_green_and_blue():
    red, blue = np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2, 3), np.uint8)
    red[..., 0], blue[..., 2] = 255, 255
    assert gray_image(red)[0, 0] == 76 and gray_image(blue)[0, 0] == 29


@pytest.mark.parametrize(
    ("image", "error"),
    [
        (np.zeros((2, 2), bool), ShapeError),
        (np.zeros((2, 2), np.int64), ShapeError),
        (np.zeros((2, 2), complex), ShapeError),
        (np.zeros((2, 2, 2), np.uint8), ShapeError),
        (np.zeros(4, np.uint8), ShapeError),
        (np.zeros((0, 4), np.uint8), ShapeError),
        (np.full((2, 2), np.nan), ConfigError),
        (np.full((2, 2), -0.1), ConfigError),
        ("image.png", ShapeError),
    ],
)
def test_what_is_no_image_is_refused(image, error):
    with pytest.raises(error):
        gray_image(image)
    with pytest.raises(error):
        Frame.from_images(0.0, image)


def test_white_must_be_positive(gray):
    for white in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ConfigError, match="white"):
            gray_image(gray, white)


def test_color_frames_are_tracked_as_gray_ones():
    frames, plain, colored = ride().frames("stereo")[:4], Slam(SlamCamera.of_rig(FLAT)), []
    system = Slam(SlamCamera.of_rig(FLAT))
    for frame in frames:
        sides = [np.repeat(side[..., None], 3, axis=2) for side in (frame.gray, frame.right_gray)]
        colored.append(system.track(Frame.from_images(frame.timestamp_s, *sides)))
        expected = plain.track(frame)
        np.testing.assert_array_equal(
            colored[-1].world_from_body.translation, expected.world_from_body.translation
        )


def test_a_rectified_pair_stays_as_it_is_and_a_raw_one_is_rectified(rng):
    left, right = rng.integers(0, 256, (2, 240, 320), np.uint8)
    flat = Frame.from_pair(0.5, left, right, FLAT)
    assert flat.gray is left and flat.right_gray is right and flat.timestamp_s == 0.5
    assert SlamCamera.of_rig(FLAT).baseline == pytest.approx(BASELINE)
    frame, camera, expected = Frame.from_pair(0.5, left, right, RAW), SlamCamera.of_rig(RAW), rectify(RAW)
    for found, wanted in zip((frame.gray, frame.right_gray), expected.apply(left, right)):
        np.testing.assert_array_equal(found, wanted)
    assert camera.camera.model == CameraModel.PINHOLE and camera.baseline == pytest.approx(RAW.baseline)
    assert camera.checked(frame).gray.shape == (camera.camera.height, camera.camera.width)
    with pytest.raises(ShapeError, match="right image"):
        Frame.from_pair(0.5, left, right[::2], RAW)
    swapped = StereoRig(LENS, LENS, RAW.right_from_left.inverse())
    with pytest.raises(ConfigError, match="swapped"):
        Frame.from_pair(0.5, left, right, swapped)
