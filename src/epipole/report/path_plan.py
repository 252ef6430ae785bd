"""Trajectories seen from above, over the density of the map's points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from markupsafe import Markup

from epipole.report.charts import nice_ticks, tick_text
from epipole.report.frame import render_piece
from epipole.report.plan import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, PlanFrame, density_of
from epipole.scene import Curve

_MARGIN = 0.08
_MIDDLE_PERCENT = (10.0, 90.0)
"""Percentiles of the points that are included in the view, besides the full trajectories."""
_COLORS = ("accent", "soft", "warn", "loop")


def draw_path_plan(
    curves: Sequence[Curve],
    points_in_world: Float64[np.ndarray, "n 3"],
    ends_in_world: Float64[np.ndarray, "k 3"],
    unit: str,
) -> Markup:
    """Draw trajectories with world x to the right and y up, seen against +z; empty if there are none.

    Args:
        curves: in the order of the colors accent, soft, warn, loop; empty curves are omitted from the legend.
        points_in_world: the map's points; rows that are not finite are ignored.
        ends_in_world: the first and the last position of the trajectory.
        unit: unit of the axes.
    """
    rendered = [curve for curve in curves if len(curve.segments_in_world)]
    if not rendered:
        return Markup("")
    points = points_in_world[np.isfinite(points_in_world).all(axis=1)]
    frame = _frame_around(np.concatenate([c.segments_in_world.reshape(-1, 3) for c in rendered]), points)
    x_ticks, y_ticks = nice_ticks(frame.x_low, frame.x_high, 5), nice_ticks(frame.y_low, frame.y_high, 5)
    return render_piece(
        "epipole.report",
        "path_plan.html.jinja",
        width=WIDTH,
        height=HEIGHT,
        left=LEFT,
        right=WIDTH - RIGHT,
        top=TOP,
        bottom=HEIGHT - BOTTOM,
        unit=unit,
        x_ticks=[(f"{frame.x_of(t):.1f}", tick_text(t)) for t in x_ticks],
        y_ticks=[(f"{(y := frame.y_of(t)):.1f}", f"{y + 3.5:.1f}", tick_text(t)) for t in y_ticks],
        density=density_of(points, frame),
        lines=[
            (curve.name, color, _path(curve, frame))
            for curve, color in zip(curves, _COLORS)
            if len(curve.segments_in_world)
        ],
        ends=[
            (f"{frame.x_of(x):.1f}", f"{frame.y_of(y):.1f}", words)
            for (x, y, _), words in zip(ends_in_world.tolist(), ("begin", "end"))
        ],
    )


def _frame_around(positions: np.ndarray, points: np.ndarray) -> PlanFrame:
    corners = positions[:, :2]
    if len(points):
        corners = np.concatenate([corners, np.percentile(points[:, :2], _MIDDLE_PERCENT, axis=0)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = (1 + 2 * _MARGIN) * np.maximum(high - low, 1e-9)
    room = np.array([WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM])
    scale = float((room / size).min())
    corner = 0.5 * (low + high) - 0.5 * room / scale
    return PlanFrame(float(corner[0]), float(corner[1]), scale)


def _path(curve: Curve, frame: PlanFrame) -> str:
    steps: list[str] = []
    last: tuple[str, str] | None = None
    for start, end in curve.segments_in_world[:, :, :2].tolist():
        first = (f"{frame.x_of(start[0]):.1f}", f"{frame.y_of(start[1]):.1f}")
        if first != last:
            steps.append(f"M{first[0]} {first[1]}")
        last = (f"{frame.x_of(end[0]):.1f}", f"{frame.y_of(end[1]):.1f}")
        steps.append(f"L{last[0]} {last[1]}")
    return "".join(steps)
