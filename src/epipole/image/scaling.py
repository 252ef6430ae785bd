"""Downscaling of images."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

from epipole._checks import checked
from epipole.errors import ConfigError


@checked
def downscaled(
    image: UInt8[np.ndarray, "h w *channels"], max_side_px: int
) -> UInt8[np.ndarray, "h2 w2 *channels"]:
    """The image downscaled by area averaging to this longer side; the same array if it is not larger.

    Raises:
        ConfigError: the image is empty or has too many axes or channels, or max_side_px is not positive.
    """
    if image.ndim > 3 or (image.ndim == 3 and image.shape[2] > 4) or image.size == 0 or max_side_px < 1:
        raise ConfigError(f"an image of shape {image.shape} cannot be downscaled to {max_side_px} pixels")
    height, width = image.shape[:2]
    factor = max_side_px / max(height, width)
    if factor >= 1.0:
        return image
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
