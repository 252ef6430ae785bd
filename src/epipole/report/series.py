"""Values over frames, and the state of each frame, as inline SVG."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from markupsafe import Markup

from epipole.report.charts import nice_ticks, tick_text
from epipole.report.frame import render_piece

_WIDTH, _HEIGHT = 560, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 78, 14, 30, 52
_STRIP_TOP, _STRIP_HEIGHT = 12, 26
_TOP_PERCENT, _HEADROOM = 99.0, 1.15


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A value for each of some frames."""

    name: str
    x: Float64[np.ndarray, " n"]
    """Frame numbers in ascending order."""
    y: Float64[np.ndarray, " n"]
    """NaN breaks the line."""
    color: str = "accent"
    """accent, warn or soft."""


@dataclass(frozen=True, slots=True)
class Band:
    """Consecutive frames in the same state."""

    first: int
    last: int
    kind: str
    """Suffix of a band-... class in the style sheet."""
    hint: str
    """Text shown on hover."""


def draw_lines(
    lines: Sequence[Line], span: tuple[float, float], y_label: str, x_label: str = "frame"
) -> Markup:
    """Line chart over one axis, from zero up; empty if nothing is finite.

    The axis ends slightly above the 99th percentile; higher values are cut off, and a label says so.
    """
    every = np.concatenate([line.y for line in lines]) if lines else np.zeros(0)
    every = every[np.isfinite(every)]
    if not len(every):
        return Markup("")
    top = float(np.percentile(every, _TOP_PERCENT))
    high = float(every.max()) if every.max() <= _HEADROOM * top else top
    high = 1.05 * high if high > 0 else 1.0
    low, bottom = min(0.0, float(every.min())), _HEIGHT - _BOTTOM

    def y_of(value: float) -> float:
        return bottom - (min(value, high) - low) / (high - low) * (bottom - _TOP)

    num_beyond = int((every > high).sum())
    return render_piece(
        "epipole.report",
        "series.html.jinja",
        **_axes(span, _HEIGHT, bottom),
        top=_TOP,
        x_label=x_label,
        y_label=y_label,
        y_ticks=[(f"{y_of(t):.1f}", f"{y_of(t) + 4:.1f}", tick_text(t)) for t in nice_ticks(low, high, 4)],
        lines=[(line.color, _path(line, span, y_of)) for line in lines],
        beyond=f"{num_beyond} beyond, up to {every.max():.3g}" if num_beyond else "",
    )


def draw_strip(bands: Sequence[Band], marks: Sequence[int], span: tuple[float, float]) -> Markup:
    """A strip of bands over the frame numbers, with ticks above it at `marks`."""
    bottom = _STRIP_TOP + _STRIP_HEIGHT
    positions = []
    for band in bands:
        left, right = _x_of(band.first - 0.5, span), _x_of(band.last + 0.5, span)
        positions.append((band.kind, f"{left:.2f}", f"{max(right - left, 0.8):.2f}", band.hint))
    return render_piece(
        "epipole.report",
        "strip.html.jinja",
        **_axes(span, bottom + 22, bottom),
        top=_STRIP_TOP,
        bands=positions,
        marks="".join(f"M{_x_of(m, span):.1f} 3V{_STRIP_TOP - 2}" for m in marks),
    )


def _x_of(value: float, span: tuple[float, float]) -> float:
    low, high = span
    return _LEFT + (value - low) / max(high - low, 1e-12) * (_WIDTH - _LEFT - _RIGHT)


def _axes(span: tuple[float, float], height: int, bottom: int) -> dict[str, object]:
    return {
        "width": _WIDTH,
        "height": height,
        "left": _LEFT,
        "right": _WIDTH - _RIGHT,
        "bottom": bottom,
        "x_ticks": [(f"{_x_of(t, span):.1f}", tick_text(t)) for t in nice_ticks(*span, 5)],
    }


def _path(line: Line, span: tuple[float, float], y_of: Callable[[float], float]) -> str:
    """The line, broken at gaps; a single value between gaps is a short stroke."""
    known = np.isfinite(line.y)
    steps = []
    for k in np.flatnonzero(known):
        at = f"{_x_of(float(line.x[k]), span):.1f} {y_of(float(line.y[k])):.1f}"
        is_first = k == 0 or not known[k - 1]
        is_alone = is_first and (k + 1 == len(known) or not known[k + 1])
        steps.append(f"M{at}m-2 0h4" if is_alone else f"{'M' if is_first else 'L'}{at}")
    return "".join(steps)
