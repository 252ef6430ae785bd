"""Search ranges of image tiles from the disparities at half resolution."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from epipole._checks import check_pixels, checked
from epipole.errors import ShapeError

TILE_PX = 384
MARGIN_PX = 24
"""Margin of a tile on every side, in which its paths start."""
_SPARE_PX = 6
"""Margin of the search range beyond the coarse disparities, at full resolution."""
_BESIDE = 1
"""Neighboring tiles in each direction whose coarse disparities are included, since objects cross borders."""


@dataclass(frozen=True, slots=True)
class Tile:
    """A rectangle of the image and its search range."""

    rows: tuple[int, int]
    columns: tuple[int, int]
    disparities: tuple[int, int]
    """Smallest and largest."""


@checked
def tiles_of(
    coarse_px: Float32[np.ndarray, "h2 w2"], shape: tuple[int, int], search: tuple[int, int]
) -> Iterator[Tile]:
    """The tiles of an image, each with the range of the coarse disparities in it and its neighbors.

    Args:
        coarse_px: disparities at half resolution, in pixels of that resolution; NaN where unknown.
        shape: height and width of the image.
        search: smallest and largest disparity of the entire image.

    Raises:
        ShapeError: an image is empty.
        ConfigError: the image is too large.
    """
    height, width = shape
    if coarse_px.size == 0 or min(shape) < 1:
        raise ShapeError(f"images must not be empty, got {coarse_px.shape} and {shape}")
    check_pixels(width, height)
    rows, columns = -(-height // TILE_PX), -(-width // TILE_PX)
    scale = width / coarse_px.shape[1]
    low = np.full((rows, columns), np.inf)
    high = np.full((rows, columns), -np.inf)
    half = TILE_PX / scale
    for r in range(rows):
        for c in range(columns):
            own = coarse_px[int(r * half) : int((r + 1) * half) + 1, int(c * half) : int((c + 1) * half) + 1]
            known = own[np.isfinite(own)]
            if known.size:
                low[r, c], high[r, c] = scale * known.min(), scale * known.max()
    for r in range(rows):
        for c in range(columns):
            near = np.s_[max(r - _BESIDE, 0) : r + _BESIDE + 1, max(c - _BESIDE, 0) : c + _BESIDE + 1]
            first, last = low[near].min(), high[near].max()
            if not np.isfinite(first):
                first, last = float(search[0]), float(search[1])
            yield Tile(
                (r * TILE_PX, min((r + 1) * TILE_PX, height)),
                (c * TILE_PX, min((c + 1) * TILE_PX, width)),
                (
                    int(np.clip(np.floor(first) - _SPARE_PX, search[0], search[1] - 1)),
                    int(np.clip(np.ceil(last) + _SPARE_PX, search[0] + 1, search[1])),
                ),
            )
