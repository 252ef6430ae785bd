"""The census transform."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8, UInt16

from epipole import _parallel
from epipole.image._census_kernels import census_rows


def census(image: UInt16[np.ndarray, "h w"], window: tuple[int, int]) -> UInt8[np.ndarray, "h w planes"]:
    """Which pixels of a window are darker than its middle, a bit each (Zabih and Woodfill, ECCV 1994).

    Unchanged by whatever keeps the order of brightness: exposure, gain, gamma.

    Args:
        image: one channel.
        window: width and height, odd.

    Returns:
        Eight bits a byte, row by row of the window; beyond the border the nearest pixel counts.
    """
    width, height = window
    out = np.empty((*image.shape, -(-(width * height - 1) // 8)), np.uint8)
    _parallel.map_chunks(
        lambda a, b, _: census_rows(image, width // 2, height // 2, a, b, out), image.shape[0]
    )
    return out
