"""Depth loss at known points (Deng et al., "Depth-supervised NeRF", CVPR 2022)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from epipole._checks import checked
from epipole.fields.splat.rasterizer import Rendering
from epipole.fields.training_view import TrainingView

LEAST_COVERAGE = np.float32(0.1)
"""Smallest coverage of a pixel whose rendered depth is compared."""


class PointDepths(NamedTuple):
    """Pixels of an image at which known points are visible."""

    row: np.ndarray
    column: np.ndarray
    depth: np.ndarray
    """(n,) along the optical axis."""


class DepthLoss(NamedTuple):
    """Depth loss and its derivatives."""

    loss: float
    """Weight times mean |log(rendered / known)|, independent of the unit."""
    by_depth: np.ndarray
    """(h, w) derivative w.r.t. the rendered depth."""
    by_coverage: np.ndarray
    """(h, w) derivative w.r.t. the rendered coverage."""


@checked
def point_depths(view: TrainingView) -> PointDepths:
    """Depths of the points of a view; the nearest one of each pixel."""
    points = np.zeros((0, 3)) if view.points_in_world is None else view.points_in_world
    positions = view.cam_from_world.apply(points)
    pixels = view.camera.project(positions)
    inside = np.isfinite(pixels).all(axis=1) & (positions[:, 2] > 0)
    at = np.rint(np.where(inside[:, None], pixels, -1.0)).astype(np.int64)
    inside &= (at >= 0).all(axis=1) & (at[:, 0] < view.camera.width) & (at[:, 1] < view.camera.height)
    column, row, depth = at[inside, 0], at[inside, 1], positions[inside, 2]
    order = np.argsort(depth, kind="stable")
    first = order[np.unique(row[order] * view.camera.width + column[order], return_index=True)[1]]
    return PointDepths(row[first], column[first], depth[first].astype(np.float32))


def depth_loss(rendered: Rendering, known: PointDepths, weight: float) -> DepthLoss:
    """Depth loss; the depth of a pixel is D / C, with D the depth times coverage C."""
    by_depth, by_coverage = np.zeros_like(rendered.depth), np.zeros_like(rendered.coverage)
    at = known.row, known.column
    shown = rendered.coverage[at] > LEAST_COVERAGE
    at = known.row[shown], known.column[shown]
    if not len(at[0]):
        return DepthLoss(0.0, by_depth, by_coverage)
    depth, coverage = rendered.depth[at], rendered.coverage[at]
    off = np.log(depth / (coverage * known.depth[shown]))
    sign = np.sign(off) * np.float32(weight / len(off))
    by_depth[at], by_coverage[at] = sign / depth, -sign / coverage
    return DepthLoss(weight * float(np.abs(off).mean(dtype=np.float64)), by_depth, by_coverage)
