"""Conversion between epipole's camera models and OpenCV's camera matrices and coefficient vectors."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError

_PLAIN, _RATIONAL = 4, 8
_SAME = 1e-6
_LENGTHS = (0, 4, 5, 8, 12, 14)


def coefficients_of_camera(camera: Camera) -> tuple[str, np.ndarray]:
    """("fisheye", (k1, k2, k3, k4)), ("plumb_bob", (k1, k2, p1, p2, k3)) or ("rational_polynomial", (... k4, k5, k6))."""
    rest = camera.params[list(camera.model.distortion_indices)]
    if camera.model == CameraModel.OPENCV_FISHEYE:
        return "fisheye", rest.copy()
    out = np.zeros(_RATIONAL)
    out[: len(rest)] = rest
    return ("rational_polynomial", out) if out[5:].any() else ("plumb_bob", out[:5])


def camera_of_coefficients(
    path: Path, size: tuple[int, int], K: np.ndarray, coefficients: np.ndarray, *, is_fisheye: bool
) -> Camera:
    """The camera with this matrix and these coefficients in OpenCV's order.

    Raises:
        FileFormatError: there is skew, thin prism or tilt, or the numbers are not a valid camera.
    """
    require_plain(path, K)
    d = np.asarray(coefficients, np.float64).ravel()
    if not is_fisheye and len(d) not in _LENGTHS:
        raise FileFormatError(path, f"it has {len(d)} distortion coefficients, not 4, 5, 8, 12 or 14")
    if d[_PLAIN if is_fisheye else _RATIONAL :].any():
        raise FileFormatError(
            path,
            f"it has {len(d)} distortion coefficients; thin prism and tilt (beyond k6) are not supported",
        )
    rest = np.zeros(_RATIONAL)
    rest[: min(len(d), _RATIONAL)] = d[:_RATIONAL]
    if is_fisheye:
        model, rest = CameraModel.OPENCV_FISHEYE, rest[:_PLAIN]
    elif rest[_PLAIN:].any():
        model = CameraModel.FULL_OPENCV
    else:
        model, rest = CameraModel.OPENCV, rest[:_PLAIN]
    try:
        return Camera(model, *size, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *rest]))
    except ConfigError as error:
        raise FileFormatError(path, str(error)) from error


def require_plain(path: Path, K: np.ndarray) -> None:
    """Check that a camera matrix has no entries other than fx, fy, cx and cy.

    Raises:
        FileFormatError: the matrix has skew, or is scaled.
    """
    if abs(K[0, 1]) > _SAME * abs(K[0, 0]):
        raise FileFormatError(path, "the camera matrix has skew, which is not supported")
    if abs(K[1, 0]) > _SAME * abs(K[0, 0]) or np.abs(K[2] - [0.0, 0.0, 1.0]).max() > _SAME:
        raise FileFormatError(path, "the camera matrix is not (fx 0 cx, 0 fy cy, 0 0 1)")
