"""Depth at edges and in holes: the hypothesis that a small window of the images supports.

Semi-global matching makes foreground objects wider by parts of its window, and sources hidden behind them disagree with the others. There, the
depth of the pixel, of each source and of the pixels around is tested by the correlation of a 5 x 5 window with bilateral weights (Schoenberger,
Zheng, Pollefeys and Frahm, ECCV 2016, equation 10), on the plane of the pixel that it comes from, in the two sources that match best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from epipole import _parallel
from epipole.dense import _edge_kernels as kernels

JUMP, EDGE_PX = 1.02, 3
"""Ratio of inverse depths within this distance that is an edge."""
RADII_PX = (3, 10)
"""Distances of the pixels, in eight directions, whose depths are tested."""
SLOPE_REACH_PX, SLOPE_TOLERANCE = 5, 0.02
"""Reach of the window that gives slopes, and relative difference of its pixels."""
MOST_HYPOTHESES = 32
_ROWS = 16


@dataclass(frozen=True, slots=True, eq=False)
class EdgeChoice:
    """Chosen inverse depths; `zone` has the pixels that were tested."""

    zone: np.ndarray
    inverse_depth: np.ndarray
    """The given one where nothing could be tested."""
    cost: np.ndarray
    """One minus the mean correlation with the two best sources."""
    num_matching: np.ndarray
    """Number of sources whose window is similar."""


def choose_at_edges(
    inverse_depth: np.ndarray,
    is_hole: np.ndarray,
    raw: np.ndarray,
    grays: Sequence[np.ndarray],
    views: tuple[np.ndarray, ...],
) -> EdgeChoice:
    """Choose the inverse depth of pixels at edges and of holes.

    Args:
        inverse_depth: (h, w) of the reference view; NaN where unknown.
        is_hole: (h, w) unknown pixels that may get a depth.
        raw: (n, h, w) inverse depth of each source; NaN where unknown.
        grays: gray images of the reference view and of the n sources.
        views: intrinsics of the reference; rotations (n, 9) and translations (n, 3) to the sources, their intrinsics (n, 4) and sizes (n, 2).
    """
    shape = inverse_depth.shape
    zone = is_hole | _is_edge(inverse_depth)
    slopes = np.zeros((*shape, 2), np.float32)
    chosen, cost, matching = (
        np.empty(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty(shape, np.uint8),
    )
    images = grays[0], _stacked(grays[1:])
    offsets, num = _offsets(), len(raw)

    def slope(start: int, stop: int, _: int) -> None:
        tolerance = np.float32(SLOPE_TOLERANCE)
        kernels.slope_rows(inverse_depth, SLOPE_REACH_PX, tolerance, start, stop, slopes)

    def choose(start: int, stop: int, _: int) -> None:
        window = np.empty(kernels.TAPS**2), np.empty(kernels.TAPS**2)
        memory = *window, np.empty((MOST_HYPOTHESES, 3)), np.empty(num)
        known, out = (zone, inverse_depth, slopes), (chosen, cost, matching)
        kernels.choose_rows(known, raw, images, views, offsets, memory, start, stop, out)

    for work in (slope, choose):
        _parallel.map_chunks(work, shape[0], -(-shape[0] // _ROWS))
    return EdgeChoice(zone, chosen, cost, matching)


def _is_edge(inverse_depth: np.ndarray) -> np.ndarray:
    window = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    known = np.isfinite(inverse_depth)
    largest = cv2.dilate(np.where(known, inverse_depth, np.float32(0.0)), window)
    smallest = cv2.erode(np.where(known, inverse_depth, np.float32(np.inf)), window)
    return known & (largest / np.float32(JUMP) > smallest)


def _offsets() -> np.ndarray:
    """(m, 2) offsets of rows and columns."""
    rows = []
    for radius in RADII_PX:
        along = round(radius / np.sqrt(2.0))
        rows += [(-radius, 0), (radius, 0), (0, -radius), (0, radius)]
        rows += [(-along, -along), (along, along), (-along, along), (along, -along)]
    return np.array(rows, np.int64)


def _stacked(grays: Sequence[np.ndarray]) -> np.ndarray:
    """(n, h, w) images in one array, as large as the largest; the rest is not read."""
    height, width = (max((gray.shape[axis] for gray in grays), default=1) for axis in (0, 1))
    out = np.zeros((len(grays), height, width), np.uint8)
    for row, gray in zip(out, grays):
        row[: gray.shape[0], : gray.shape[1]] = gray
    return out
