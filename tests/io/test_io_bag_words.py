"""CameraInfo messages: words and pixels that are not understood are refused."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.errors import FileFormatError
from epipole.io.bags._images import camera_of

K = np.array([404.0, 0.0, 320.0, 0.0, 404.0, 240.0, 0.0, 0.0, 1.0])


def found(**own: Any) -> Camera | None:
    whole = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    message = {
        "width": 640,
        "height": 480,
        "distortion_model": "plumb_bob",
        "k": K,
        "d": np.array([0.1, 0, 0, 0.2]),
    }
    message |= {
        "p": np.column_stack([K.reshape(3, 3), np.zeros(3)]).ravel(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": whole,
    }
    return camera_of(Path("ride.bag"), SimpleNamespace(**message | own), is_rectified=False)


@pytest.mark.parametrize(
    ("own", "model"),
    [
        ({}, CameraModel.OPENCV),
        ({"distortion_model": "equidistant"}, CameraModel.OPENCV_FISHEYE),
        ({"distortion_model": "kannala_brandt"}, CameraModel.OPENCV_FISHEYE),
        ({"distortion_model": "none", "d": np.empty(0)}, CameraModel.PINHOLE),
        ({"binning_x": 1, "roi": SimpleNamespace(x_offset=0, y_offset=0, width=640, height=480)}, CameraModel.OPENCV),
    ],
)  # fmt: skip
def test_known_words(own, model) -> None:
    assert found(**own).model is model


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"distortion_model": "fov"}, "unknown distortion_model fov"),
        ({"distortion_model": "none"}, "none, but distortion coefficients are not zero"),
        ({"binning_x": 2}, "binning_x = 2 is not supported"),
        ({"binning_y": 4}, "binning_y = 4 is not supported"),
        ({"roi": SimpleNamespace(x_offset=16, y_offset=0, width=100, height=100)}, "x_offset = 16"),
        ({"k": K + np.array([0, 5.0, 0, 0, 0, 0, 0, 0, 0])}, "skew"),
        ({"k": 2 * K, "d": np.zeros(5)}, "the camera matrix is not"),
    ],
)
def test_what_changes_the_camera_and_is_not_understood(own, message) -> None:
    with pytest.raises(FileFormatError, match=message):
        found(**own)
