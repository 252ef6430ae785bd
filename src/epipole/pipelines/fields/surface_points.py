"""The surface of a radiance field as colored points, for the 3D view of its report.

Depth and color are rendered at a few training views. Pixels are back-projected if their depth is certain: the field is opaque
there, the depth does not jump, and other views measure the same depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import NamedTuple

import numpy as np

from epipole._jit import compile_seconds
from epipole.fields.training_view import TrainingView
from epipole.pipelines.fields.cameras import RenderView, sized
from epipole.pipelines.fields.scene import UNIT, cameras_of
from epipole.pipelines.fields.surfaces import Seen
from epipole.report.markup import plural
from epipole.report.space_scene import FirstView, PointLayer, SpaceScene

MOST_POINTS = 50_000
MOST_VIEWS = 24
"""Views that are rendered, at most, evenly spaced over all."""
PIXELS, LEAST_PIXELS, PROBE_PIXELS = 150_000, 30_000, 2_000
"""Pixels of all these views together, about half of which have a certain depth; the fewest, if the field renders slowly; and those
that measure its speed."""
SECONDS = 4.0
"""Time for rendering them, as measured with the probe."""
LEAST_COVERAGE = 0.9
"""Smallest coverage of a pixel with a surface; less is fog, or a border."""
LARGEST_JUMP = 0.08
"""Largest difference in depth between neighboring pixels, relative to the depth, on one surface."""
AGREEING = 0.03
"""Largest difference from the depth that another view has of a point, relative to the depth."""
LEAST_AGREEING = 2
"""Other views that must have the same depth, if enough views are rendered."""


class SurfacePoints(NamedTuple):
    """Points of a surface and their colors."""

    points_in_world: np.ndarray
    """(n, 3)"""
    rgb: np.ndarray
    """(n, 3), 8 bits."""


class _DepthView(NamedTuple):
    view: RenderView
    depth: np.ndarray
    """(h, w) along the optical axis; NaN where it is not certain."""
    rgb: np.ndarray


def scene_of_surface(
    render: Callable[[RenderView], Seen],
    views: Sequence[TrainingView],
    first_view: dict[str, list[float]],
    title: str,
) -> SpaceScene | None:
    """The surface of a field as points, with the training cameras; None if no pixel has a certain depth.

    Args:
        render: renders the field from a view.
        views: the training views.
        first_view: from `first_view_of`.
        title: title of the scene.
    """
    found = surface_points(render, views)
    if not len(found.points_in_world):
        return None
    view = FirstView(*(np.array(first_view[name]) for name in ("position", "look_at", "up")))
    words = f"{plural(len(found.points_in_world), 'point')} on surfaces of the field, from depth rendered at training views"
    layer = PointLayer("Surface points", found.points_in_world, found.rgb)
    return SpaceScene(title, words, UNIT, (layer,), cameras_of(views), view=view)


def surface_points(
    render: Callable[[RenderView], Seen], views: Sequence[TrainingView], most_points: int = MOST_POINTS
) -> SurfacePoints:
    """Points with certain depth, as seen from a spread of the views.

    Args:
        render: renders the field from a view.
        views: the training views.
        most_points: largest number of points; a random sample of all.
    """
    if not len(views):
        return SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    rows = np.unique(np.linspace(0, len(views) - 1, MOST_VIEWS).round().astype(np.int64)).tolist()
    num_pixels = _pixels_in_time(render, views[len(views) // 2])
    seen = [_depth_view(render, views[row], num_pixels / len(rows)) for row in rows]
    needed = min(LEAST_AGREEING, max(len(seen) - 2, 0))
    parts = [_agreeing_points(k, seen, needed) for k in range(len(seen))]
    points, rgb = (np.concatenate(each) for each in zip(*parts))
    chosen = np.sort(np.random.default_rng(0).permutation(len(points))[:most_points])
    return SurfacePoints(points[chosen], rgb[chosen])


def _pixels_in_time(render: Callable[[RenderView], Seen], view: TrainingView) -> float:
    """Number of pixels that can be rendered in SECONDS, from one small view; kernel compilation does not count."""
    start, compiled = perf_counter(), compile_seconds()
    num_probed = _depth_view(render, view, PROBE_PIXELS).depth.size
    seconds = max(perf_counter() - start - (compile_seconds() - compiled), 1e-6)
    return float(np.clip(num_probed * SECONDS / seconds, LEAST_PIXELS, PIXELS))


def _depth_view(render: Callable[[RenderView], Seen], view: TrainingView, num_pixels: float) -> _DepthView:
    """Render a view with about `num_pixels` pixels, and keep the depth where it is certain."""
    ratio = np.sqrt(num_pixels / (view.camera.width * view.camera.height))
    camera = sized(view.camera, max(8, round(view.camera.width * min(1.0, ratio))))
    small = RenderView(view.name, camera, view.cam_from_world)
    found = render(small)
    depth = np.where(
        found.coverage > LEAST_COVERAGE, found.depth / np.maximum(found.coverage, LEAST_COVERAGE), np.nan
    )
    color = found.color / np.maximum(found.coverage, LEAST_COVERAGE)[..., None]
    rgb = np.rint(255.0 * np.clip(np.nan_to_num(color), 0.0, 1.0)).astype(np.uint8)
    return _DepthView(small, _without_jumps(depth), rgb)


def _without_jumps(depth: np.ndarray) -> np.ndarray:
    """The depth, NaN next to a jump: such a pixel shows two surfaces, and its depth lies between them."""
    out = depth.copy()
    for axis in (0, 1):
        first, second = (np.take(depth, range(k, depth.shape[axis] - 1 + k), axis) for k in (0, 1))
        jumps = np.abs(first - second) > LARGEST_JUMP * np.fmin(first, second)
        pad = [(0, 0), (0, 0)]
        for side in ((0, 1), (1, 0)):
            pad[axis] = side
            out[np.pad(jumps, pad)] = np.nan
    return out


def _agreeing_points(k: int, seen: Sequence[_DepthView], needed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of view `k` whose depth at least `needed` of the other views confirm, and their colors."""
    own = seen[k]
    rows, columns = np.nonzero(own.depth > 0)
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    rays = own.view.camera.unproject(pixels)
    in_camera = rays / rays[:, 2:] * own.depth[rows, columns][:, None]
    points = own.view.cam_from_world.inverse().apply(in_camera)
    num_agreeing = sum(
        (_agrees(points, other) for n, other in enumerate(seen) if n != k), np.zeros(len(points), np.int64)
    )
    kept = num_agreeing >= needed
    return points[kept], own.rgb[rows, columns][kept]


def _agrees(points: np.ndarray, other: _DepthView) -> np.ndarray:
    """Mask of the points that lie at the depth that another view has of them."""
    in_camera = other.view.cam_from_world.apply(points)
    z = in_camera[:, 2]
    pixels = np.nan_to_num(other.view.camera.project(in_camera), nan=-1e6)
    column, row = np.rint(np.clip(pixels, -1e6, 1e6)).astype(np.int64).T
    height, width = other.depth.shape
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    out = np.zeros(len(points), bool)
    found = other.depth[row[inside], column[inside]]
    out[inside] = np.abs(found - z[inside]) <= AGREEING * z[inside]
    return out
