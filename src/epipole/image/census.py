"""The census transform."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8, UInt16

from epipole import _parallel
from epipole._checks import checked
from epipole.errors import ConfigError
from epipole.image._census_kernels import census_rows

_MOST_PIXELS = 1 << 12


@checked
def census(image: UInt16[np.ndarray, "h w"], window: tuple[int, int]) -> UInt8[np.ndarray, "h w planes"]:
    """One bit per pixel of a window, set if it is darker than the center (Zabih and Woodfill, ECCV 1994).

    Invariant to any monotonic change of brightness, such as exposure, gain or gamma.

    Args:
        image: one channel.
        window: width and height, odd.

    Returns:
        Eight bits per byte, row by row of the window; the border is replicated.

    Raises:
        ConfigError: a side of the window is even, or it has too many pixels.
    """
    width, height = window
    if min(window) < 1 or width % 2 == 0 or height % 2 == 0 or width * height > _MOST_PIXELS:
        raise ConfigError(f"window must have odd sides and at most {_MOST_PIXELS} pixels, got {window}")
    out = np.empty((*image.shape, -(-(width * height - 1) // 8)), np.uint8)
    _parallel.map_chunks(
        lambda a, b, _: census_rows(image, width // 2, height // 2, a, b, out), image.shape[0]
    )
    return out
