"""Between our camera models and OpenCV's camera matrices and coefficient vectors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError

_NEGLIGIBLE = 1e-12
_MOST_DIFFERENCE_PX = 0.25
"""A lens with k3 and more is taken as one with k1 and k2 where that moves no pixel by more."""


def coefficients_of_camera(camera: Camera) -> tuple[str, np.ndarray]:
    """("fisheye", (k1, k2, k3, k4)) or ("pinhole", (k1, k2, p1, p2, 0))."""
    rest = camera.params[list(camera.model.distortion_indices)]
    if camera.model == CameraModel.OPENCV_FISHEYE:
        return "fisheye", rest.copy()
    out = np.zeros(5)
    out[: len(rest)] = rest
    return "pinhole", out


def camera_of_coefficients(
    path: Path, size: tuple[int, int], K: np.ndarray, coefficients: np.ndarray, *, is_fisheye: bool
) -> Camera:
    """The camera with this matrix and these coefficients in OpenCV's order.

    Coefficients beyond the fourth (k3, rational and thin prism terms) are fitted by k1, k2, p1 and p2 over the picture.

    Raises:
        FileFormatError: that moves some pixel by more than a quarter, or the numbers make no camera.
    """
    d = np.asarray(coefficients, np.float64).ravel()
    four = np.zeros(4)
    four[: min(4, len(d))] = d[:4]
    if abs(K[0, 1]) > 1e-6 * abs(K[0, 0]):
        raise FileFormatError(path, "the camera matrix has skew, which is not supported")
    params = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *four])
    model = CameraModel.OPENCV_FISHEYE if is_fisheye else CameraModel.OPENCV
    try:
        camera = Camera(model, *size, params)
    except ConfigError as error:
        raise FileFormatError(path, str(error)) from error
    if is_fisheye or not (np.abs(d[4:]) > _NEGLIGIBLE).any():
        return camera
    return _refitted(path, camera, d)


def _refitted(path: Path, camera: Camera, d: np.ndarray) -> Camera:
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 25))
    fx, fy, cx, cy = camera.params[:4]
    seen = np.stack([(u.ravel() - cx) / fx, (v.ravel() - cy) / fy], axis=1)
    plane = seen.copy()
    for _ in range(200):  # the inverse of the lens by fixed point, damped: only where to compare
        plane -= 0.5 * (_distorted(plane, d) - seen)
    plane = plane[np.isfinite(plane).all(axis=1)]
    plane = plane[np.linalg.norm(_distorted(plane, d), axis=1) < 1.05 * np.linalg.norm(seen, axis=1).max()]
    focal = np.array([fx, fy])
    wanted = _distorted(plane, d)

    def off(four: np.ndarray) -> np.ndarray:
        return ((_distorted(plane, four) - wanted) * focal).ravel()

    found = least_squares(off, d[:4], method="lm")
    largest = float(np.abs(found.fun).max()) if len(plane) else np.inf
    if largest > _MOST_DIFFERENCE_PX:
        raise FileFormatError(
            path,
            f"its {len(d)} distortion coefficients cannot be said by k1, k2, p1 and p2: pixels would move by up to "
            f"{largest:.2f} px. Calibrate again without k3 and later ones (cv2.CALIB_FIX_K3)",
        )
    return Camera(camera.model, camera.width, camera.height, np.concatenate([camera.params[:4], found.x]))


def _distorted(plane: np.ndarray, d: np.ndarray) -> np.ndarray:
    """OpenCV's distortion of points on z = 1 with 4, 5, 8 or 12 coefficients."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.concatenate([d, np.zeros(12)])[:12]
    x, y = plane.T
    with np.errstate(over="ignore", invalid="ignore"):
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
    return np.stack([u, v], axis=1)
