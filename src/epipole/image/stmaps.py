"""STMaps: images whose values are the position, in another image, from which each pixel is taken (Nuke's STMap node).

    s = (u + 0.5) / width,    t = 1 - (v + 0.5) / height

(u, v) is the position in pixels, where (0, 0) is the center of the top-left pixel; s and t are 0 at the left and the bottom edge of
the other image, and 1 at its right and top edge.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64

from epipole._checks import check_pixels, checked
from epipole.cameras import Camera
from epipole.image.undistort import undistortion_map_px

NOT_VISIBLE = -1.0
"""Value of s and t where the other image does not show the pixel; Nuke gives black."""
_ROWS = 256
"""Rows of an image at a time, which limits the memory."""
_FARTHEST = -1e3
"""Smaller positions of `undistortion_map_px`, in pixels, mean that a pixel is not visible."""


@checked
def undistortion_stmap(camera: Camera, pinhole: Camera) -> Float32[np.ndarray, "h w 2"]:
    """The map that undistorts images of `camera`, in the size of `pinhole`.

    Args:
        camera: the camera, of any model.
        pinhole: the camera of the undistorted images.

    Returns:
        (h, w, 2) s and t in the image of `camera`, top row first; `NOT_VISIBLE` where the camera does not see the ray.

    Raises:
        ConfigError: the undistorted image is too large.
    """
    pixels = undistortion_map_px(camera, pinhole).astype(np.float64)
    return _stmap(np.where(pixels > _FARTHEST, pixels, np.nan), camera)


@checked
def distortion_stmap(camera: Camera, pinhole: Camera) -> Float32[np.ndarray, "h w 2"]:
    """The map that distorts images of `pinhole` again, in the size of `camera`.

    Args:
        camera: the camera, of any model.
        pinhole: the camera of the undistorted images.

    Returns:
        (h, w, 2) s and t in the image of `pinhole`, top row first; outside 0 to 1 for pixels beyond its border, and
        `NOT_VISIBLE` where a pixel has no ray that `pinhole` can see.

    Raises:
        ConfigError: the image is too large.
    """
    check_pixels(camera.width, camera.height)
    out = np.empty((camera.height, camera.width, 2), np.float32)
    u = np.arange(camera.width, dtype=np.float64)
    for top in range(0, camera.height, _ROWS):
        rows = np.arange(top, min(top + _ROWS, camera.height), dtype=np.float64)
        pixels = np.stack([np.tile(u, len(rows)), np.repeat(rows, camera.width)], axis=1)
        undistorted = pinhole.project(camera.unproject(pixels))
        out[top : top + _ROWS] = _stmap(undistorted.reshape(len(rows), camera.width, 2), pinhole)
    return out


def _stmap(pixels: Float64[np.ndarray, "h w 2"], camera: Camera) -> Float32[np.ndarray, "h w 2"]:
    """S and t of positions in the image of a camera; NaN is not visible."""
    st = (pixels + 0.5) / [camera.width, camera.height]
    st[..., 1] = 1.0 - st[..., 1]
    is_visible = np.isfinite(st).all(axis=-1, keepdims=True)
    return np.where(is_visible, st, NOT_VISIBLE).astype(np.float32)
