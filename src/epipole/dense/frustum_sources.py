"""Selection of the source views of each view without points of a model: by the parts of space that views have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from epipole.dense.source_selection import best_sources, candidates_of, check_most
from epipole.dense.view import DenseView

GRID, DEPTHS = 12, 5
"""Rays along each side of a view, and depths along each ray, whose points decide which views have a part in common."""
BYTES_TOGETHER = 1024
"""Bytes of eight points that are counted at once."""


def select_by_frusta(views: Sequence[DenseView], ranges: np.ndarray, most: int) -> list[np.ndarray]:
    """The best sources of each view, as `select_sources` chooses them from points in the part of space that each view sees.

    Each view has its points; each pair of views takes about 100 bytes, a bit for each point.

    Args:
        views: the views.
        ranges: (n, 2) smallest and largest depth of each view.
        most: largest number of sources.

    Raises:
        ConfigError: most is less than 1.
    """
    check_most(most)
    points = [_points_of(view, near, far) for view, (near, far) in zip(views, ranges)]
    every = np.concatenate([np.empty((0, 3)), *points])
    seen = [np.packbits(_sees(view, limits, every)) for view, limits in zip(views, ranges)]
    num_common = _num_common(seen)
    centers = np.array([view.cam_from_world.centers() for view in views]).reshape(-1, 3)
    focals = np.array([view.camera.focal_px for view in views], np.float64)
    chosen = []
    for k in range(len(views)):
        others = np.flatnonzero(num_common[k])
        candidates = candidates_of(k, others, num_common[k, others])
        own = _mask_of(seen[k], len(every))
        common = [_mask_of(seen[j], len(every))[own] for j in candidates.tolist()]
        rows = np.array([k, *candidates])
        chosen.append(candidates[best_sources(every[own], common, centers[rows], focals[rows], most)])
    return chosen


def _mask_of(bits: np.ndarray, number: int) -> np.ndarray:
    return np.unpackbits(bits, count=number).astype(bool)


def _num_common(seen: Sequence[np.ndarray]) -> np.ndarray:
    """(n, n) number of points that each pair of views sees, from a bit for each point and view."""
    out = np.zeros((len(seen), len(seen)), np.int64)
    for start in range(0, len(seen[0]) if seen else 0, BYTES_TOGETHER):
        ones = np.unpackbits(np.stack([bits[start : start + BYTES_TOGETHER] for bits in seen]), axis=1)
        ones = ones.astype(np.float32)
        out += (ones @ ones.T).astype(np.int64)  # exact: the numbers are below 2^24
    return out


def _points_of(view: DenseView, near: float, far: float) -> np.ndarray:
    """(n, 3) points in the part of space that a view sees."""
    camera = view.camera
    x, y = (np.linspace(0.0, side - 1.0, GRID) for side in (camera.width, camera.height))
    rays = camera.unproject(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    depth = 1.0 / np.linspace(1.0 / far, 1.0 / near, DEPTHS)
    positions = (rays / rays[:, 2:])[:, None] * depth[:, None]
    return view.cam_from_world.inverse().apply(positions.reshape(-1, 3))


def _sees(view: DenseView, limits: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n,) mask of the points that a view has in its image, up to twice its range of depth."""
    in_cam = view.cam_from_world.apply(points)
    in_front = np.flatnonzero((in_cam[:, 2] > 0.5 * limits[0]) & (in_cam[:, 2] < 2.0 * limits[1]))
    pixels = view.camera.project(in_cam[in_front])
    size = view.camera.width - 0.5, view.camera.height - 0.5
    out = np.zeros(len(points), bool)
    out[in_front] = (pixels > -0.5).all(axis=1) & (pixels < size).all(axis=1)
    return out
