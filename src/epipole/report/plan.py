"""The view from above: camera centers with their viewing directions over the density of points."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from markupsafe import Markup
from PIL import Image

from epipole.report.charts import nice_ticks, tick_text
from epipole.report.frame import render_piece
from epipole.report.markup import axis_words, data_uri
from epipole.report.space_model import stage_of
from epipole.scene import Reconstruction

WIDTH, HEIGHT = 620, 520
LEFT, RIGHT, TOP, BOTTOM = 66, 12, 12, 52
"""Margins of the grid, which contain its labels."""
_CELL = 3
"""Size of a density cell in SVG units."""


@dataclass(frozen=True, slots=True)
class PlanFrame:
    """The transform from world x, y to the drawing, with equal scales."""

    x_low: float
    y_low: float
    scale: float

    def x_of(self, x: float) -> float:
        """Distance from the left."""
        return LEFT + (x - self.x_low) * self.scale

    def y_of(self, y: float) -> float:
        """Distance from the top."""
        return HEIGHT - BOTTOM - (y - self.y_low) * self.scale

    @property
    def x_high(self) -> float:
        """World x at the right border."""
        return self.x_low + (WIDTH - LEFT - RIGHT) / self.scale

    @property
    def y_high(self) -> float:
        """World y at the top border."""
        return self.y_low + (HEIGHT - TOP - BOTTOM) / self.scale


@dataclass(frozen=True, slots=True)
class Density:
    """An image used as the mask of a plain rectangle, whose color is set by the color scheme."""

    width: int
    height: int
    uri: str


def draw_plan(reconstruction: Reconstruction, unit: str) -> Markup:
    """Draw a model with world x (east) to the right and y (north) up, seen against +z; empty for a model without cameras."""
    images = np.flatnonzero(reconstruction.is_registered())
    if not len(images):
        return Markup("")
    frame = _frame_around(reconstruction)
    cams_from_world = reconstruction.cams_from_world()[images]
    centers, forward = cams_from_world.centers(), cams_from_world.rotation[:, 2]
    points = reconstruction.points.xyz_in_world
    x_ticks, y_ticks = nice_ticks(frame.x_low, frame.x_high, 6), nice_ticks(frame.y_low, frame.y_high, 5)
    return render_piece(
        "epipole.report",
        "plan.html.jinja",
        width=WIDTH,
        height=HEIGHT,
        left=LEFT,
        right=WIDTH - RIGHT,
        top=TOP,
        bottom=HEIGHT - BOTTOM,
        unit=unit,
        axes=axis_words(is_enu=reconstruction.georeference is not None),
        x_ticks=[(f"{frame.x_of(t):.1f}", tick_text(t)) for t in x_ticks],
        y_ticks=[(f"{(y := frame.y_of(t)):.1f}", f"{y + 3.5:.1f}", tick_text(t)) for t in y_ticks],
        density=density_of(points[np.isfinite(points).all(axis=1)], frame),
        sequence=_sequence(images, centers, frame),
        cameras=[
            (name, f"{frame.x_of(center[0]):.1f}", f"{frame.y_of(center[1]):.1f}", _wedge(direction))
            for name, center, direction in zip(
                (reconstruction.images.name[i] for i in images), centers, forward
            )
        ],
    )


def _frame_around(reconstruction: Reconstruction) -> PlanFrame:
    stage = stage_of(reconstruction)
    # The stage's margin is for the 3D view; here 40 % of it is enough.
    inset = 0.6 * 0.25 / 1.5 * float((stage.high - stage.low)[:2].max())
    low, high = stage.low[:2] + inset, stage.high[:2] - inset
    middle, size = 0.5 * (low + high), np.maximum(high - low, 1e-12)
    room = np.array([WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM])
    scale = float((room / size).min())
    corner = middle - 0.5 * room / scale
    return PlanFrame(float(corner[0]), float(corner[1]), scale)


def density_of(points_in_world: Float64[np.ndarray, "n 3"], frame: PlanFrame) -> Density | None:
    """Logarithm of points per cell; None if no point is in the frame."""
    columns, rows = (WIDTH - LEFT - RIGHT) // _CELL, (HEIGHT - TOP - BOTTOM) // _CELL
    width, height = columns * _CELL, rows * _CELL
    counts = np.histogram2d(
        -points_in_world[:, 1],
        points_in_world[:, 0],
        bins=(rows, columns),
        range=(
            (-frame.y_high, -frame.y_high + height / frame.scale),
            (frame.x_low, frame.x_low + width / frame.scale),
        ),
    )[0]
    if not counts.any():
        return None
    level = np.log1p(counts) / np.log1p(np.percentile(counts[counts > 0], 99))
    gray = np.where(counts > 0, 40 + 215 * np.minimum(level, 1.0), 0).astype(np.uint8)
    stream = io.BytesIO()
    Image.fromarray(gray).save(stream, "PNG", optimize=True)
    return Density(width, height, data_uri(stream.getvalue(), "image/png"))


def _sequence(images: np.ndarray, centers: np.ndarray, frame: PlanFrame) -> str:
    """A line through neighbors in the order of names, broken where an image is not registered."""
    steps, previous = [], -2
    for image, center in zip(images, centers):
        verb = "L" if image == previous + 1 else "M"
        steps.append(f"{verb}{frame.x_of(center[0]):.1f} {frame.y_of(center[1]):.1f}")
        previous = image
    return "".join(steps)


def _wedge(forward: np.ndarray) -> str:
    """A wedge in the viewing direction, shorter if the camera looks up or down."""
    dx, dy = 15.0 * float(forward[0]), -15.0 * float(forward[1])
    left, right = (dx - 0.45 * dy, dy + 0.45 * dx), (dx + 0.45 * dy, dy - 0.45 * dx)
    return f"M0 0L{left[0]:.1f} {left[1]:.1f}L{right[0]:.1f} {right[1]:.1f}Z"
