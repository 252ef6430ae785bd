"""Bilinear colors of an image at many positions."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from epipole._checks import checked

_SIDE = 4096
"""Positions in a row: OpenCV's tables have at most 2^15 rows and columns."""


@checked
def colors_at(
    image: UInt8[np.ndarray, "h w 3"], pixels: Float32[np.ndarray, "n 2"]
) -> UInt8[np.ndarray, "n 3"]:
    """Bilinear colors at pixels; those of the border outside the image."""
    out = np.empty((len(pixels), 3), np.uint8)
    for start in range(0, len(pixels), _SIDE * _SIDE):
        part = pixels[start : start + _SIDE * _SIDE]
        rows = -(-len(part) // _SIDE)
        table = np.zeros((rows * _SIDE, 2), np.float32)
        table[: len(part)] = part
        x, y = (table[:, k].reshape(rows, _SIDE) for k in (0, 1))
        found = cv2.remap(image, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        out[start : start + len(part)] = np.asarray(found).reshape(-1, 3)[: len(part)]
    return out
