"""A view as texturing uses it: its image at working size and at full size, read when needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from epipole.cameras import Camera
from epipole.dense.view import DenseView, intrinsics_of
from epipole.geometry import Rigid3

BLUR_PX = 1.5
"""Standard deviation of the blur of images whose colors are compared: meshes are not exact to the pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class TextureView:
    """An undistorted image at two sizes."""

    name: str
    camera: Camera
    """Pinhole camera at working size, in which visibility is tested."""
    cam_from_world: Rigid3
    full_camera: Camera
    """Pinhole camera of the image that gives the texture."""
    read: Callable[[], DenseView]
    """Reads the image at working size."""
    read_full: Callable[[], UInt8[np.ndarray, "h w 3"]]
    """Reads the undistorted image at full size."""
    read_depth: Callable[[], Float32[np.ndarray, "h w"] | None] = lambda: None
    """Reads the depth at working size, NaN where unknown."""

    def used_mask(self) -> Bool[np.ndarray, "h w"] | None:
        """Pixels that show the scene; None: all."""
        return self.read().used_mask

    def colors_at(self, points_in_world: Float64[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
        """Colors of points in front of the camera, from the blurred image at working size."""
        blurred = cv2.GaussianBlur(self.read().rgb, (0, 0), BLUR_PX)
        in_cam = self.cam_from_world.apply(points_in_world)
        k = intrinsics_of(self.camera)
        pixels = (in_cam[:, :2] / in_cam[:, 2:] * k[:2] + k[2:]).astype(np.float32)
        # cv2.remap takes images with sides below 2^15, so points are arranged in rows.
        rows = -(-max(len(pixels), 1) // 4096)
        table = np.zeros((rows * 4096, 2), np.float32)
        table[: len(pixels)] = pixels
        table = table.reshape(rows, 4096, 2)
        out = np.empty((rows, 4096, 3), np.float32)
        for start in range(0, rows, 4096):
            part = table[start : start + 4096]
            out[start : start + 4096] = cv2.remap(
                blurred, part[..., 0], part[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
            )
        return out.reshape(-1, 3)[: len(pixels)]
