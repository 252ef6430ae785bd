"""Charts: connected faces with the same view, which are projected by it, and their rectangles in an atlas."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from epipole.errors import ConfigError

MARGIN_PX = 2
"""Texels around a chart, which show what surrounds it in the image, so that filtering does not mix charts."""
FLAT_PX = 4
"""Side of the square of a chart that no view shows."""
LEAST_SCALE, STEPS = 0.02, 14
"""Smallest scale of the images in the atlas, and steps of the search for the largest that fits."""


class Charts(NamedTuple):
    """Faces sorted by chart."""

    chart_of_face: np.ndarray
    """(m,)"""
    view: np.ndarray
    """(c,) view of each chart, -1 for none."""
    order: np.ndarray
    """(m,) faces, sorted by chart."""
    starts: np.ndarray
    """(c + 1,) where the faces of each chart begin in `order`."""

    def faces_of(self, chart: int) -> np.ndarray:
        """The faces of a chart."""
        return np.asarray(self.order[self.starts[chart] : self.starts[chart + 1]])

    def __len__(self) -> int:
        return len(self.view)


class Atlas(NamedTuple):
    """Rectangles of the charts in one texture."""

    side_px: int
    """Width."""
    height_px: int
    scale: float
    """Texels per pixel of the images."""
    corner: np.ndarray
    """(c, 2) column and row of the rectangles, with margins."""
    origin: np.ndarray
    """(c, 2) pixel of the scaled image at that corner."""
    size: np.ndarray
    """(c, 2) width and height, with margins."""


def charts_of(label: np.ndarray, neighbors: np.ndarray) -> Charts:
    """Connected components of faces with the same view."""
    m = len(label)
    face, edge = np.nonzero((neighbors >= 0) & (label[np.maximum(neighbors, 0)] == label[:, None]))
    graph = coo_array((np.ones(len(face), np.int8), (face, neighbors[face, edge])), shape=(m, m))
    count, chart = connected_components(graph, directed=False)
    order = np.argsort(chart, kind="stable")
    starts = np.searchsorted(chart[order], np.arange(count + 1))
    return Charts(chart.astype(np.int64), label[order[starts[:-1]]], order, starts)


def pack(charts: Charts, corners_px: np.ndarray, side_px: int) -> Atlas:
    """Put the charts into a texture, at the largest scale up to 1 at which all fit.

    Args:
        charts: the charts.
        corners_px: (m, 3, 2) pixels of the corners of each face in its view.
        side_px: width and largest height of the texture.

    Raises:
        ConfigError: the texture is too small.
    """
    by_chart = corners_px[charts.order].reshape(-1, 6)
    low = np.minimum.reduceat(by_chart, charts.starts[:-1]).reshape(-1, 3, 2).min(axis=1)
    high = np.maximum.reduceat(by_chart, charts.starts[:-1]).reshape(-1, 3, 2).max(axis=1)
    seen = charts.view >= 0
    good, scale = None, 1.0
    smallest, largest = LEAST_SCALE, 1.0
    for _ in range(STEPS):
        origin, size = _rectangles(low, high, seen, scale)
        corner = _shelves(size, side_px)
        if corner is not None:
            good, smallest = (
                Atlas(side_px, int((corner + size)[:, 1].max()), scale, corner, origin, size),
                scale,
            )
            if scale == 1.0:
                break
        else:
            largest = scale
        scale = float(np.sqrt(smallest * largest))
    if good is None:
        raise ConfigError(
            f"a texture of {side_px} pixels is too small for {len(charts):,} charts: pass a larger size"
        )
    return good


def _rectangles(
    low: np.ndarray, high: np.ndarray, seen: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Corner in the scaled image and size of each chart, with margins."""
    first = np.floor((low + 0.5) * scale - 0.5).astype(np.int64) - MARGIN_PX
    last = np.ceil((high + 0.5) * scale - 0.5).astype(np.int64) + MARGIN_PX
    size = last - first + 1
    first[~seen], size[~seen] = 0, FLAT_PX
    return first, size


def _shelves(size: np.ndarray, side_px: int) -> np.ndarray | None:
    """Corners of rectangles, highest first, in rows from left to right; None if they do not fit."""
    if size.max(initial=0) > side_px or size.astype(np.float64).prod(axis=1).sum() > side_px * side_px:
        return None
    out = np.empty_like(size)
    x = y = height = 0
    for k in np.lexsort((-size[:, 0], -size[:, 1])).tolist():
        width, own = int(size[k, 0]), int(size[k, 1])
        if x + width > side_px:
            x, y, height = 0, y + height, 0
        if y + own > side_px:
            return None
        out[k] = x, y
        x, height = x + width, max(height, own)
    return out
