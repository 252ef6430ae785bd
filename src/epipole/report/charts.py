"""Charts as inline SVG. Colors are CSS classes, so that they adapt to the light or dark scheme."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64
from markupsafe import Markup

from epipole.report.markup import count, escape, number, seconds

_WIDTH, _HEIGHT = 380, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 48, 12, 14, 42


@dataclass(frozen=True, slots=True, eq=False)
class Histogram:
    """Counts of values between edges; the last bin may include all larger values."""

    label: str
    edges: Float64[np.ndarray, " n1"]
    counts: Int64[np.ndarray, " n"]
    median: float
    num_beyond: int
    """Number of values above the last edge, which are not shown."""


def nice_ticks(low: int | float, high: int | float, target: int = 5) -> list[float]:
    """About `target` round numbers (1, 2 or 5 times a power of ten) from low to high."""
    span = high - low
    if not (math.isfinite(span) and span > 0 and target > 0):
        return [low] if math.isfinite(low) else []
    power = 10.0 ** math.floor(math.log10(span / target))
    step = min((m * power for m in (1, 2, 5, 10)), key=lambda s: abs(span / s - target))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(k * step, 12) for k in range(first, last + 1)]


def tick_text(value: int | float) -> str:
    """A short label of a tick: 12k rather than 12000."""
    if abs(value) >= 10_000:
        return f"{value / 1000:g}k"
    return f"{value:.10g}".replace("-", "\N{MINUS SIGN}")


def histogram_of(values: Float[np.ndarray, " n"], label: str, num_bins: int = 32) -> Histogram:
    """A histogram from zero to just above the 98th percentile, with round edges."""
    top = float(np.percentile(values, 98)) * 1.05 if len(values) else 0.0
    top = top if top > 0 else 1.0
    step = nice_ticks(0.0, top, num_bins)[1]
    edges = np.arange(math.ceil(top / step) + 1) * step
    counts = np.histogram(values, edges)[0]
    median = float(np.median(values)) if len(values) else math.nan
    return Histogram(label, edges, counts.astype(np.int64), median, int((values > edges[-1]).sum()))


def histogram_of_integers(values: Int64[np.ndarray, " n"], label: str, largest: int = 60) -> Histogram:
    """One bin per integer from 2 to the 99th percentile or `largest`; larger values count as beyond."""
    top = min(max(int(np.percentile(values, 99)), 8), largest) if len(values) else 8
    counts = np.bincount(np.clip(values, 0, top + 1), minlength=top + 2)
    median = float(np.median(values)) if len(values) else math.nan
    edges = np.arange(2, top + 2) - 0.5
    return Histogram(label, edges, counts[2 : top + 1].astype(np.int64), median, int(counts[top + 1]))


def draw_histogram(histogram: Histogram, digits: int = 2) -> Markup:
    """The histogram with axes, its median marked, and each bin's count on hover."""
    low, high = float(histogram.edges[0]), float(histogram.edges[-1])
    most = max(int(histogram.counts.max(initial=0)), 1)

    def x_of(value: float) -> float:
        return _LEFT + (value - low) / (high - low) * (_WIDTH - _LEFT - _RIGHT)

    def y_of(value: int | float) -> float:
        return _HEIGHT - _BOTTOM - value / (most * 1.04) * (_HEIGHT - _TOP - _BOTTOM)

    parts = [_grid_line(y_of(t), tick_text(t)) for t in nice_ticks(0, most * 1.04, 4) if t == int(t)]
    for left, right, value in zip(histogram.edges[:-1], histogram.edges[1:], histogram.counts.tolist()):
        x, y, width = x_of(left), y_of(value), x_of(right) - x_of(left)
        hint = f"{left:.4g} to {right:.4g}: {count(value)}"
        parts.append(
            f'<rect class="bar" x="{x + 0.5:.1f}" y="{y:.1f}" width="{max(width - 1, 0.5):.1f}" '
            f'height="{_HEIGHT - _BOTTOM - y:.1f}"><title>{hint}</title></rect>'
        )
    bottom = _HEIGHT - _BOTTOM
    parts += [
        f'<text class="tick" x="{x_of(t):.1f}" y="{bottom + 15}" text-anchor="middle">{tick_text(t)}</text>'
        for t in nice_ticks(low, high, 6)
    ]
    parts.append(f'<path class="axis" d="M{_LEFT} {bottom}H{_WIDTH - _RIGHT}"/>')
    if low <= histogram.median <= high:
        x = x_of(histogram.median)
        side, anchor = (x + 5, "start") if x < 0.7 * _WIDTH else (x - 5, "end")
        parts.append(f'<path class="mark" d="M{x:.1f} {_TOP - 6}V{bottom}"/>')
        parts.append(
            f'<text class="mark-text" x="{side:.1f}" y="{_TOP + 2}" text-anchor="{anchor}">'
            f"median {number(histogram.median, digits)}</text>"
        )
    parts.append(
        f'<text class="label" x="{(_LEFT + _WIDTH - _RIGHT) / 2}" y="{_HEIGHT - 8}" text-anchor="middle">'
        f"{escape(histogram.label)}</text>"
    )
    return svg(_WIDTH, _HEIGHT, parts, histogram.label)


def _grid_line(y: float, text: str) -> str:
    return (
        f'<path class="grid" d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}"/>'
        f'<text class="tick" x="{_LEFT - 7}" y="{y + 3.5:.1f}" text-anchor="end">{text}</text>'
    )


def draw_timings(timings: Mapping[str, float]) -> Markup:
    """One horizontal bar per stage, in order."""
    longest = max([*timings.values(), 1e-9])
    row, left, width = 26, 140, 520
    parts = []
    for k, (stage, value) in enumerate(timings.items()):
        y, length = k * row, max(0.0, value) / longest * (width - left - 125)
        parts.append(
            f'<text class="stage-name" x="{left - 10}" y="{y + 17}" text-anchor="end">{escape(stage)}</text>'
            f'<rect class="bar" x="{left}" y="{y + 6}" width="{max(length, 1):.1f}" height="14"/>'
            f'<text class="tick" x="{left + length + 8:.1f}" y="{y + 17}">{seconds(value)}</text>'
        )
    return svg(width, row * len(timings), parts, "seconds of each stage")


def svg(width: int, height: int, parts: Sequence[str], label: str) -> Markup:
    """An SVG element that scales with its column; `parts` must be safe markup."""
    box, inside = f"0 0 {width} {height}", "".join(parts)
    return Markup(
        f'<svg viewBox="{box}" style="--units: {width}" role="img" aria-label="{escape(label)}">{inside}</svg>'
    )


def draw_curves(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    x_label: str,
    y_label: str,
    *,
    even_y: bool = False,
) -> Markup:
    """Plot positive values with logarithmic axes (y optionally linear); at most two curves, labeled in their colors."""
    every_x = [x for xs, _ in curves.values() for x in xs if x > 0 and math.isfinite(x)]
    every_y = [y for _, ys in curves.values() for y in ys if y > 0 and math.isfinite(y)]
    if not every_x or not every_y:
        return Markup("")
    low_x, high_x = math.log10(min(every_x)), max(math.log10(max(every_x)), math.log10(min(every_x)) + 0.1)
    low_y, high_y = math.log10(min(every_y)) - 0.05, math.log10(max(every_y)) + 0.05
    if even_y:
        margin = 0.05 * (max(every_y) - min(every_y)) + 1e-3 * max(every_y)
        low_y, high_y = min(every_y) - margin, max(every_y) + margin

    def x_of(value: float) -> float:
        return _LEFT + (math.log10(value) - low_x) / (high_x - low_x) * (_WIDTH - _LEFT - _RIGHT)

    def y_of(value: float) -> float:
        fraction = ((value if even_y else math.log10(value)) - low_y) / (high_y - low_y)
        return _HEIGHT - _BOTTOM - fraction * (_HEIGHT - _TOP - _BOTTOM)

    ticks = nice_ticks(low_y, high_y) if even_y else _decades(low_y, high_y)
    parts = [_grid_line(y_of(t), tick_text(t)) for t in ticks]
    bottom = _HEIGHT - _BOTTOM
    parts += [
        f'<text class="tick" x="{x_of(t):.1f}" y="{bottom + 15}" text-anchor="middle">{tick_text(t)}</text>'
        for t in _decades(low_x, high_x)
    ]
    parts.append(f'<path class="axis" d="M{_LEFT} {bottom}H{_WIDTH - _RIGHT}"/>')
    for k, (name, (xs, ys)) in enumerate(curves.items()):
        known = [(x_of(x), y_of(y)) for x, y in zip(xs, ys) if x > 0 and y > 0 and math.isfinite(y)]
        if not known:
            continue
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in known)
        style = ("sequence", "mark")[k % 2]
        parts.append(f'<path class="{style}" style="stroke-opacity:1;stroke-width:1.6" d="M{path}"/>')
        color = ("var(--accent)", "var(--warn)")[k % 2]
        parts.append(
            f'<text class="label" style="fill:{color}" x="{_WIDTH - _RIGHT - 4}" y="{_TOP + 2 + 16 * k}" text-anchor="end">'
            f"{escape(name)}</text>"
        )
    parts.append(
        f'<text class="label" x="{(_LEFT + _WIDTH - _RIGHT) / 2}" y="{_HEIGHT - 8}" text-anchor="middle">'
        f"{escape(x_label)}</text>"
    )
    parts.append(f'<text class="label" x="{_LEFT}" y="{_TOP - 3}">{escape(y_label)}</text>')
    return svg(_WIDTH, _HEIGHT, parts, f"{y_label} against {x_label}")


def _decades(low: float, high: float) -> list[float]:
    """1, 2, 5, 10 ... between powers of ten; only powers of ten if there would be too many."""
    factors = (1.0,) if high - low > 2.5 else (1.0, 2.0, 5.0)
    steps = [m * 10.0**k for k in range(math.floor(low), math.ceil(high) + 1) for m in factors]
    return [t for t in steps if low - 1e-9 <= math.log10(t) <= high + 1e-9]
