"""Where in the range of disparities each tile of an image needs to be searched: what an image of half the size shows there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from epipole._checks import check_pixels, checked
from epipole.errors import ShapeError

TILE_PX = 384
MARGIN_PX = 24
"""Beyond a tile on every side, in which its paths begin."""
_SPARE_PX = 6
"""Disparities searched beyond those of the coarse image, at full size."""
_BESIDE = 1
"""Tiles whose coarse disparities count too: things reach over borders."""


@dataclass(frozen=True, slots=True)
class Tile:
    """A rectangle of the image and its disparities."""

    rows: tuple[int, int]
    columns: tuple[int, int]
    disparities: tuple[int, int]
    """First and last."""


@checked
def tiles_of(
    coarse_px: Float32[np.ndarray, "h2 w2"], shape: tuple[int, int], search: tuple[int, int]
) -> Iterator[Tile]:
    """The tiles of an image, each with the range in which its own and its neighbours' coarse disparities lie.

    Args:
        coarse_px: disparities of the image of half the size, in its own pixels; NaN where unknown.
        shape: height and width of the image.
        search: first and last disparity of the whole image.

    Raises:
        ShapeError: an image is empty.
        ConfigError: it is too large.
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
