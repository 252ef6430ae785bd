"""Brown's distortion in the notation of photogrammetry (Metashape, RealityScan), and as a camera model of OpenCV's kind.

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 x^2) + 2 p2 x y        (y' alike, p1 and p2 exchanged)

Compared with OPENCV, p1 and p2 are exchanged.
"""

from __future__ import annotations

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError

COEFFICIENTS = ("k1", "k2", "k3", "p1", "p2")
MAX_ASPECT_DIFFERENCE = 0.01
"""In formats with one focal length, fx and fy may differ by at most this fraction."""


def brown_model(k1: float, k2: float, k3: float, p1: float, p2: float) -> tuple[CameraModel, list[float]]:
    """The smallest camera model with these coefficients, and its distortion parameters."""
    distortion = [k1, k2, p2, p1]
    if k3:
        return CameraModel.FULL_OPENCV, [*distortion, k3, 0.0, 0.0, 0.0]
    return (CameraModel.OPENCV, distortion) if any(distortion) else (CameraModel.PINHOLE, [])


def brown_coefficients(camera: Camera, program: str) -> dict[str, float]:
    """The coefficients k1, k2, k3, p1 and p2 of a perspective camera.

    Args:
        camera: the camera.
        program: name of the program, for errors.

    Raises:
        ConfigError: the distortion is that of a fisheye or rational model.
    """
    if camera.model == CameraModel.OPENCV_FISHEYE:
        raise ConfigError(f"{program} has no fisheye camera model: undistort the images first")
    d = np.zeros(8)
    values = camera.params[list(camera.model.distortion_indices)]
    d[: len(values)] = values
    if d[5:].any():
        raise ConfigError(f"{program} has no rational camera model (k4 to k6): undistort the images first")
    return dict(zip(("k1", "k2", "p2", "p1", "k3"), d.tolist()))


def one_focal_px(camera: Camera, program: str) -> float:
    """The mean focal length in pixels, for formats that have one.

    Raises:
        ConfigError: the two focal lengths differ by more than `MAX_ASPECT_DIFFERENCE`.
    """
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    if abs(fx - fy) > MAX_ASPECT_DIFFERENCE * fx:
        raise ConfigError(f"{program} has a single focal length, but this camera has {fx:g} and {fy:g}")
    return camera.focal_px


def refuse_distortion(camera: Camera, program: str) -> None:
    """Check that a camera is a pinhole camera.

    Raises:
        ConfigError: it has distortion.
    """
    is_fisheye = camera.model == CameraModel.OPENCV_FISHEYE
    if is_fisheye or camera.params[list(camera.model.distortion_indices)].any():
        raise ConfigError(f"{program} has no distortion: undistort the images first (`epipole undistort`)")
