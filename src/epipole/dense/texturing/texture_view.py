"""A view as texturing uses it: its image at working size and at full size, read when needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from epipole.cameras import Camera
from epipole.dense.texturing.sampling import colors_at
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
        blurred = np.asarray(cv2.GaussianBlur(self.read().rgb, (0, 0), BLUR_PX), np.uint8)
        in_cam = self.cam_from_world.apply(points_in_world)
        k = intrinsics_of(self.camera)
        pixels = (in_cam[:, :2] / in_cam[:, 2:] * k[:2] + k[2:]).astype(np.float32)
        return colors_at(blurred, pixels).astype(np.float32)
