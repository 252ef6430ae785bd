"""Pictures without lens distortion."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from epipole._checks import check_pixels
from epipole._declared import checked
from epipole.cameras import Camera, CameraModel


@checked
def undistorted_camera(camera: Camera) -> Camera:
    """The PINHOLE camera whose picture shows nothing beyond this camera's border.

    The focal length stays; the picture is cropped to the largest rectangle whose rays all lie inside.
    """
    if camera.model in (CameraModel.SIMPLE_PINHOLE, CameraModel.PINHOLE):
        params = np.array([camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]])
        return Camera(CameraModel.PINHOLE, camera.width, camera.height, params)
    w, h = camera.width, camera.height
    x, y = np.linspace(-0.5, w - 0.5, 65), np.linspace(-0.5, h - 0.5, 65)
    sides = []
    for pixels, axis in (
        (np.stack([np.full(65, -0.5), y], 1), 0),
        (np.stack([np.full(65, w - 0.5), y], 1), 0),
        (np.stack([x, np.full(65, -0.5)], 1), 1),
        (np.stack([x, np.full(65, h - 0.5)], 1), 1),
    ):
        rays = camera.unproject(pixels)
        usable = rays[:, 2] > 0.05
        sides.append((rays[usable, axis] / rays[usable, 2]) if usable.any() else np.array([0.0]))
    left, right, top, bottom = sides[0].max(), sides[1].min(), sides[2].max(), sides[3].min()
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    # A camera cannot show 90 degrees to the side on a plane: bound the picture at three times the focal length.
    left, top = max(left, -3.0), max(top, -3.0)
    right, bottom = min(right, 3.0), min(bottom, 3.0)
    width, height = max(1, int(fx * (right - left))), max(1, int(fy * (bottom - top)))
    params = np.array([fx, fy, -fx * left - 0.5, -fy * top - 0.5])
    return Camera(CameraModel.PINHOLE, width, height, params)


@checked
def undistort_image(
    rgb: UInt8[np.ndarray, "h w 3"], camera: Camera, pinhole: Camera
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Resample a picture of `camera` as `pinhole` sees it (bilinear); black where the camera saw nothing.

    Raises:
        ConfigError: the new picture is too large.
    """
    if camera.model in (CameraModel.SIMPLE_PINHOLE, CameraModel.PINHOLE):
        return rgb
    table = undistortion_map_px(camera, pinhole)
    return cv2.remap(rgb, table[..., 0], table[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def undistortion_map_px(camera: Camera, pinhole: Camera) -> Float32[np.ndarray, "h w 2"]:
    """Where each pixel of `pinhole` lies in the picture of `camera`; far outside where that saw nothing.

    Raises:
        ConfigError: the new picture is too large.
    """
    check_pixels(pinhole.width, pinhole.height)
    u, v = np.meshgrid(
        np.arange(pinhole.width, dtype=np.float64), np.arange(pinhole.height, dtype=np.float64)
    )
    rays = pinhole.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
    source = np.nan_to_num(camera.project(rays), nan=-1e4).astype(np.float32)
    return source.reshape(pinhole.height, pinhole.width, 2)
