"""Points from stereo of neighboring views, as additional initial Gaussians where a model has few points.

At training resolution a pair takes a tenth of a second, so stereo finds these points faster than training would (EDGS
does the same with a network; Kotovenko et al., 2025). The pairs are not combined as in `epipole surface`: with its fused points, which are as
dense wherever views see the surface, held-out views of Herz-Jesus-P8 were 0.5 to 1 dB worse.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from epipole.dense.source_selection import SharedPoints, select_sources
from epipole.disparity_search.config import DisparityConfig
from epipole.disparity_search.rectification import Rectification, is_right_of_left, rectify, within_both
from epipole.disparity_search.search import match_stereo
from epipole.errors import EpipoleError
from epipole.fields.training_view import TrainingView
from epipole.scene import StereoRig

SIDE_PX = 480
"""Maximum side of the matched images; larger ones are downscaled by an integer factor."""
PARTNERS = 2
"""Views that each view is paired with, at most."""
RANGE_FRACTION, RANGE_PX = 0.15, 4.0
"""Margin of the disparity search around the known points: fraction of their range, and pixels."""
MOST_ERROR = 0.01
"""Largest standard deviation of a disparity, relative to the disparity (and so of the depth)."""


class DensePoints(NamedTuple):
    """Points in the world and their colors."""

    points_in_world: np.ndarray
    rgb: np.ndarray


def dense_points(
    views: Sequence[TrainingView], count: int, seed: int, progress: Callable[[int, int], None]
) -> DensePoints:
    """Random subset of at most `count` points found by stereo; empty if no pair of views works.

    Args:
        views: pinhole cameras with the model's points that they see.
        count: maximum number of points.
        seed: random seed.
        progress: called with the number of pairs done and the number of all.
    """
    pairs, found = neighbors_of(views), list[DensePoints]()
    for n, (one, other) in enumerate(pairs):
        progress(n, len(pairs))
        try:
            found.append(_points_of_pair(views[one], views[other]))
        except EpipoleError:  # one camera is in front of the other, or they share no row
            continue
    progress(len(pairs), len(pairs))
    if not found:
        return DensePoints(np.empty((0, 3)), np.empty((0, 3), np.uint8))
    points, rgb = (np.concatenate(parts) for parts in zip(*found))
    chosen = np.sort(np.random.default_rng([23, seed]).permutation(len(points))[:count])
    return DensePoints(points[chosen], rgb[chosen])


def neighbors_of(views: Sequence[TrainingView]) -> list[tuple[int, int]]:
    """Pairs of views that see the same points at a good triangulation angle, as `epipole surface` selects them."""
    rows = [_known(view) for view in views]
    # Views have copies of the model's points: points with equal coordinates are the same.
    points, point = np.unique(np.concatenate([np.empty((0, 3)), *rows]), axis=0, return_inverse=True)
    seen = SharedPoints(points, np.repeat(np.arange(len(views)), [len(row) for row in rows]), point.ravel())
    centers = np.array([view.cam_from_world.centers() for view in views]).reshape(-1, 3)
    focals = np.array([view.camera.focal_px for view in views], np.float64)
    sources = select_sources(seen, centers, focals, PARTNERS)
    return sorted({(min(k, j), max(k, j)) for k, row in enumerate(sources) for j in row.tolist()})


def _known(view: TrainingView) -> np.ndarray:
    points = np.empty((0, 3)) if view.points_in_world is None else view.points_in_world
    return points[np.isfinite(points).all(axis=1)]


def _points_of_pair(one: TrainingView, other: TrainingView) -> DensePoints:
    """Stereo points of a pair of views, from the left one.

    Raises:
        DegenerateGeometryError: the pair cannot be rectified.
        ConfigError: the disparity range is empty.
    """
    longest = max(one.camera.width, one.camera.height, other.camera.width, other.camera.height)
    left, right = (view.smaller(-(-longest // SIDE_PX)) for view in (one, other))
    rig = StereoRig(left.camera, right.camera, right.cam_from_world @ left.cam_from_world.inverse())
    if is_right_of_left(rig):
        rig, left, right = rig.swapped(), right, left
    flat = rectify(rig)
    images = flat.apply(*(np.ascontiguousarray(view.image[..., :3]) for view in (left, right)))
    known = left.cam_from_world.apply(np.concatenate([_known(left), _known(right)]))
    found = match_stereo(*images, _range_of(flat, known))
    found = within_both(found, flat.left_valid, flat.right_valid)
    disparity = found.disparity_px + flat.rig.principal_offset_px
    with np.errstate(invalid="ignore"):
        good = (disparity > 0) & (found.sigma_px < MOST_ERROR * disparity) & _is_used(flat, left)
    row, column = np.nonzero(good)
    depth = flat.rig.focal_px * flat.rig.baseline / disparity[good].astype(np.float64)
    rays = np.stack([column - flat.rig.cx, row - flat.rig.cy, np.full(len(row), flat.rig.focal_px)], axis=1)
    positions = (rays * (depth / flat.rig.focal_px)[:, None]) @ flat.rectified_from_left
    return DensePoints(left.cam_from_world.inverse().apply(positions), images[0][good])


def _range_of(flat: Rectification, positions: np.ndarray) -> DisparityConfig:
    """Disparity range of points (n, 3) in the left camera's frame, with a margin."""
    depth = positions @ flat.rectified_from_left[2]
    disparities = flat.rig.focal_px * flat.rig.baseline / depth[depth > 0] - flat.rig.principal_offset_px
    low, high = np.quantile(disparities, [0.01, 0.99])
    more = RANGE_FRACTION * (high - low) + RANGE_PX
    return DisparityConfig(min_disparity_px=int(low - more), max_disparity_px=int(high + more))


def _is_used(flat: Rectification, view: TrainingView) -> np.ndarray:
    """(h, w) whether a pixel of the rectified left image is neither masked nor transparent."""
    used = np.ones(view.image.shape[:2], bool) if view.used_mask is None else view.used_mask
    if view.image.shape[2] == 4:
        used = used & (view.image[..., 3] > 0)
    at = np.rint(flat.left_map_px).astype(np.int64)
    inside = (at >= 0).all(axis=2) & (at[..., 0] < view.camera.width) & (at[..., 1] < view.camera.height)
    at = np.where(inside[..., None], at, 0)
    return np.asarray(inside & used[at[..., 1], at[..., 0]])
