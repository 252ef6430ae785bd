"""An image to train on, at the resolutions that the training needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from epipole._checks import Declared, check_fields, checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3


@dataclass(frozen=True, slots=True, eq=False)
class TrainingView(Declared):
    """An undistorted image and its camera."""

    name: str
    image: UInt8[np.ndarray, "h w c"]
    """RGB, or RGBA with straight alpha."""
    camera: Camera
    cam_from_world: Rigid3
    used_mask: Bool[np.ndarray, "h w"] | None = None
    """Pixels to train on and to compare; None: all."""
    points_in_world: Float64[np.ndarray, "n 3"] | None = None
    """Points of the model that are visible in the image."""

    def __post_init__(self) -> None:
        """Check that image and camera match.

        Raises:
            ShapeError: they do not.
        """
        check_fields(self)
        if self.image.shape != (self.camera.height, self.camera.width, self.image.shape[2]):
            raise ShapeError(f"{self.name}: image and camera have different sizes")
        if self.cam_from_world.batch_shape() != ():
            raise ShapeError(f"{self.name}: cam_from_world must be a single pose")
        if not np.isfinite(self.cam_from_world.as_matrix()).all():
            raise ShapeError(f"{self.name}: cam_from_world is not finite")
        if self.image.shape[2] not in (3, 4):
            raise ShapeError(f"{self.name}: an image must have 3 or 4 channels, got {self.image.shape[2]}")

    def __repr__(self) -> str:
        return f"TrainingView({self.name!r}, {self.camera.width} x {self.camera.height})"

    @checked
    def smaller(self, factor: int) -> TrainingView:
        """Downscale image, camera and mask by an integer factor, averaging pixels (premultiplied by alpha).

        Raises:
            ConfigError: the factor is not positive, or leaves no pixel.
        """
        if not 1 <= factor <= min(self.camera.width, self.camera.height):
            raise ConfigError(
                f"factor must be from 1 to the shorter side of {self.camera.width} x {self.camera.height}, got {factor}"
            )
        if factor == 1:
            return self
        width, height = self.camera.width // factor, self.camera.height // factor
        params = self.camera.params.copy()
        params[:2] /= factor
        params[2:4] = (params[2:4] + 0.5) / factor - 0.5
        camera = Camera(self.camera.model, width, height, params)
        cut = self.image[: height * factor, : width * factor]
        mask = self.used_mask
        if mask is not None:
            mask = shrunk_mask(mask[: height * factor, : width * factor], (width, height))
        return replace(self, image=shrunk(cut, (width, height)), camera=camera, used_mask=mask)

    @checked
    def over(self, background: Float32[np.ndarray, " 3"]) -> Float32[np.ndarray, "h w 3"]:
        """The image, from 0 to 1, over a background color."""
        rgb = self.image[..., :3].astype(np.float32) / np.float32(255.0)
        if self.image.shape[2] == 3:
            return rgb
        alpha = self.image[..., 3:].astype(np.float32) / np.float32(255.0)
        return rgb * alpha + (np.float32(1.0) - alpha) * background


def shrunk_mask(used_mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Downscale a mask; a pixel is used if all pixels it covers are."""
    full = np.where(used_mask, np.uint8(255), np.uint8(0))
    return np.asarray(cv2.resize(full, size, interpolation=cv2.INTER_AREA) == 255)


def shrunk(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Downscale an image by averaging pixels, with colors weighted by alpha."""
    if image.shape[2] == 3:
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    alpha = image[..., 3:].astype(np.float32)
    color = cv2.resize(image[..., :3] * alpha, size, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(alpha, size, interpolation=cv2.INTER_AREA)[..., None]
    rgb = np.divide(color, mean, out=np.zeros_like(color), where=mean > 0)
    return np.rint(np.concatenate([rgb, mean], axis=2)).astype(np.uint8)
