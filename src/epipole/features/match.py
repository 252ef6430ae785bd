"""Exhaustive nearest-neighbour matching with ratio test and mutual check."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int32, UInt8

from epipole.config import MatchConfig
from epipole.errors import ShapeError
from epipole.features import _matching_kernels as kernels
from epipole.features.features import Features

_BLOCK_ROWS = 256
_STRIP_PX = 32.0
"""Width of the strips in which features along a line are looked up."""
_UNIT = 512.0
"""Length of a root-SIFT descriptor."""


def match_descriptors(
    descriptors1: UInt8[np.ndarray, "n d"],
    descriptors2: UInt8[np.ndarray, "m e"],
    config: MatchConfig | None = None,
) -> Int32[np.ndarray, "k 2"]:
    """Index pairs of mutual nearest neighbours that pass the ratio test (Lowe, IJCV 2004, section 7.1).

    128 columns are root-SIFT, compared by angle; 32 are ORB's bits.

    Raises:
        ShapeError: descriptors of different or unknown width.
    """
    config = config or MatchConfig()
    width = descriptors1.shape[1]
    if width != descriptors2.shape[1] or width not in (32, 128):
        raise ShapeError(f"cannot match descriptors of widths {width} and {descriptors2.shape[1]}")
    if min(len(descriptors1), len(descriptors2)) == 0:
        return np.empty((0, 2), np.int32)
    if width == 32:
        return _match_bits(descriptors1, descriptors2, config)
    return match_sift_floats(descriptors1.astype(np.float32), descriptors2.astype(np.float32), config)


def match_sift_floats(a: np.ndarray, b: np.ndarray, config: MatchConfig) -> Int32[np.ndarray, "k 2"]:
    """As `match_descriptors` for root-SIFT already converted to float32 (n, 128), C-contiguous.

    Work: 2 * 128 * n * m operations in the matrix product, one read of n * m numbers for the top two. The
    product is made in blocks of rows that stay in the cache.
    """
    n, m = len(a), len(b)
    block = np.empty((min(_BLOCK_ROWS, n), m), np.float32)
    best, second = np.empty(n, np.float32), np.empty(n, np.float32)
    column, column_best = np.full(n, -1, np.int32), np.full(m, -1.0, np.float32)
    passes = np.zeros(n, bool)
    for start in range(0, n, _BLOCK_ROWS):
        stop = min(start + _BLOCK_ROWS, n)
        rows = stop - start
        np.dot(a[start:stop], b.T, out=block[:rows])
        kernels.top_two(block, rows, best[start:stop], second[start:stop], column_best)
        nearest, next_nearest = _angle(best[start:stop]), _angle(second[start:stop])
        passes[start:stop] = (nearest < config.max_ratio * next_nearest) & (nearest <= config.max_distance)
        kernels.find_best_column(block, rows, best[start:stop], passes[start:stop], column[start:stop])
    rows1 = np.flatnonzero(passes)
    mutual = best[rows1] == column_best[column[rows1]]
    return _one_to_one(rows1[mutual], column[rows1[mutual]])


def match_along_epipolar_lines(
    features1: Features,
    features2: Features,
    fundamental: Float64[np.ndarray, "3 3"],
    band_px: float,
    config: MatchConfig | None = None,
) -> Int32[np.ndarray, "k 2"]:
    """Mutual nearest SIFT neighbours among the features within `band_px` of each other's epipolar line.

    A line crosses about one hundredth of a picture's features, so that this costs a small part of comparing
    all with all; the ratio test is among the candidates of the line.

    Args:
        features1: of image 1.
        features2: of image 2.
        fundamental: x2^T F x1 = 0, pixels.
        band_px: half width of the band around a line.
        config: ratio and distance bounds.
    """
    config = config or MatchConfig()
    n, m = len(features1), len(features2)
    if min(n, m) == 0:
        return np.empty((0, 2), np.int32)
    pixels2 = np.ascontiguousarray(features2.pixels.T, np.float64)
    strips = [_strips(pixels2[d], pixels2[1 - d]) for d in range(2)]
    column, best, second = np.empty(n, np.int64), np.empty(n, np.int32), np.empty(n, np.int32)
    column_best = np.full(m, -1, np.int32)
    kernels.guided_top_two(
        *(features1.pixels.astype(np.float64), features1.descriptors.astype(np.int16)),
        *(pixels2, features2.descriptors.astype(np.int16), np.ascontiguousarray(fundamental), float(band_px)),
        *(_STRIP_PX, (strips[0][0], strips[1][0]), (strips[0][1], strips[1][1])),
        *(column, best, second, column_best),
    )
    nearest, next_nearest = _angle(best), _angle(second)
    passes = (column >= 0) & (nearest < config.max_ratio * next_nearest) & (nearest <= config.max_distance)
    rows1 = np.flatnonzero(passes)
    mutual = best[rows1] == column_best[column[rows1]]
    return _one_to_one(rows1[mutual], column[rows1[mutual]])


def _strips(position: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Features by strip of `position`, inside a strip by `other`; and the first of each strip."""
    strip = np.clip(position // _STRIP_PX, 0, None).astype(np.int64)
    order = np.lexsort((other, strip))
    return order, np.searchsorted(strip[order], np.arange(int(strip.max()) + 2))


def _angle(similarity: np.ndarray) -> np.ndarray:
    return np.arccos(np.clip(similarity / (_UNIT * _UNIT), 0.0, 1.0))


def _match_bits(a: np.ndarray, b: np.ndarray, config: MatchConfig) -> np.ndarray:
    wide_a, wide_b = np.ascontiguousarray(a).view(np.uint64), np.ascontiguousarray(b).view(np.uint64)
    column, best, second = (np.empty(len(a), np.int64) for _ in range(3))
    column_best = np.full(len(b), 1 << 30, np.int64)
    kernels.hamming_top_two(wide_a, wide_b, column, best, second, column_best)
    passes = (best <= config.max_bits) & (best < config.max_ratio * second)
    rows1 = np.flatnonzero(passes & (best == column_best[column]))
    return _one_to_one(rows1, column[rows1])


def _one_to_one(rows1: np.ndarray, rows2: np.ndarray) -> np.ndarray:
    """Drop later rows that claim a column already taken (only exact ties of distance do)."""
    _, first = np.unique(rows2, return_index=True)
    first.sort()
    return np.stack([rows1[first], rows2[first]], axis=1).astype(np.int32)
