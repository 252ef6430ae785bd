"""Images of any type as 8-bit gray ones."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from epipole._checks import as_image, checked
from epipole.errors import ConfigError, ShapeError

_WHITE = {"u1": 255.0, "u2": 65535.0, "f4": 1.0, "f8": 1.0}
"""Value of white by type, unless it is given."""


@checked
def gray_image(image: Any, white: float | None = None) -> UInt8[np.ndarray, "h w"]:
    """A gray or color image as 8-bit gray; an 8-bit gray image is returned unchanged.

    Args:
        image: (h, w), (h, w, 1), RGB (h, w, 3) or RGBA (h, w, 4); 8 or 16 bits, or floating point.
        white: value of white; None: 255, 65535 or 1.0, by type. Larger values become white. Images with 12 bits need 4095. All images
            of a sequence should have the same value.

    Raises:
        ShapeError: it is not such an image.
        ConfigError: `white` is not positive, or a value is negative or not finite.
    """
    array = as_image(image, "image")
    kind = f"{array.dtype.kind}{array.dtype.itemsize}"
    if kind not in _WHITE:
        raise ShapeError(f"an image has 8 or 16 bits or floating-point values, not {array.dtype}")
    if array.ndim not in (2, 3) or array.size == 0 or (array.ndim == 3 and array.shape[2] not in (1, 3, 4)):
        raise ShapeError(f"an image is (h, w), (h, w, 3) or (h, w, 4), not {array.shape}")
    if white is not None and not 0 < white < np.inf:
        raise ConfigError(f"white must be positive and finite, got {white}")
    if array.dtype.kind == "f" and not (np.isfinite(array).all() and array.min() >= 0):
        raise ConfigError("an image has negative values or values that are not finite")
    scale = 255.0 / (_WHITE[kind] if white is None else white)
    if kind != "u1" or scale != 1.0:
        array = np.rint(np.minimum(array.astype(np.float32) * np.float32(scale), 255.0)).astype(np.uint8)
    if array.ndim == 2:
        return array
    if array.shape[2] == 1:
        return np.ascontiguousarray(array[..., 0])
    gray: np.ndarray = cv2.cvtColor(array, cv2.COLOR_RGB2GRAY if array.shape[2] == 3 else cv2.COLOR_RGBA2GRAY)
    return gray
