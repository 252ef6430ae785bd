"""An undistorted image with its camera, as dense reconstruction uses it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8

from epipole._checks import Declared, check_fields
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3


@dataclass(frozen=True, slots=True, eq=False)
class DenseView(Declared):
    """An undistorted image, its pinhole camera and its pose."""

    name: str
    rgb: UInt8[np.ndarray, "h w 3"]
    camera: Camera
    cam_from_world: Rigid3
    used_mask: Bool[np.ndarray, "h w"] | None = None
    """Pixels that show the scene; None: all."""

    def __post_init__(self) -> None:
        """Check that image, mask, camera and pose match.

        Raises:
            ShapeError: they do not.
            ConfigError: the camera is not a pinhole.
        """
        check_fields(self)
        if self.camera.model not in (CameraModel.PINHOLE, CameraModel.SIMPLE_PINHOLE):
            raise ConfigError(
                f"{self.name}: the camera must be PINHOLE or SIMPLE_PINHOLE: undistort the image"
            )
        size = (self.camera.height, self.camera.width)
        if self.rgb.shape[:2] != size or (self.used_mask is not None and self.used_mask.shape != size):
            raise ShapeError(f"{self.name}: image, mask and camera have different sizes")
        if self.cam_from_world.batch_shape() != () or not np.isfinite(self.cam_from_world.as_matrix()).all():
            raise ShapeError(f"{self.name}: cam_from_world must be a single finite pose")

    def __repr__(self) -> str:
        return f"DenseView({self.name!r}, {self.camera.width} x {self.camera.height})"


def intrinsics_of(camera: Camera) -> np.ndarray:
    """(fx, fy, cx, cy) of a pinhole camera."""
    K = camera.K
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
