"""Charts of the report page over the frames: states, inliers, position uncertainty, time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from epipole.pipelines.slam.output.record import FrameRecord, stretches
from epipole.report.series import Band, Line, draw_lines, draw_strip

PERCENTILES = (50, 90, 95, 99, 100)


def state_strip(records: Sequence[FrameRecord]) -> Markup:
    """Strip of the states of all frames, with keyframes as ticks."""
    bands = []
    for part in stretches(records):
        frames = f"frame {part.first}" if part.count == 1 else f"frames {part.first} to {part.last}"
        hint = f"{frames}: {part.state}" + (f", {part.reason}" if part.reason else "")
        bands.append(Band(part.first, part.last, part.state.replace(" ", "-"), hint))
    marks = [r.number for r in records if r.answer is not None and r.answer.is_keyframe]
    return draw_strip(bands, marks, _span(records))


def keyframe_reasons(records: Sequence[FrameRecord]) -> list[tuple[str, int]]:
    """Reasons for keyframes and their counts, most frequent first."""
    out: dict[str, int] = {}
    for record in records:
        if record.answer is not None and record.answer.is_keyframe:
            reason = record.answer.reason.split("; ")[0]
            out[reason] = out.get(reason, 0) + 1
    return sorted(out.items(), key=lambda row: -row[1])


def frame_charts(records: Sequence[FrameRecord], unit: str) -> list[tuple[str, Markup, str]]:
    """Title, SVG and caption of each chart over the frames."""
    numbers = np.array([record.number for record in records], np.float64)
    span = _span(records)
    points = np.array([_num_points(record) for record in records])
    ms = np.array([1e3 * record.seconds for record in records])
    sigma = np.array([record.sigma_position for record in records])
    charts = (
        (
            "Inliers",
            Line("", numbers, points),
            "points",
            "Map points that agree with the frame's pose. Gaps are frames without a pose.",
        ),
        (
            "Position uncertainty",
            Line("", numbers, sigma),
            f"1 sigma of the position ({unit})",
            "If the camera measures depth, from the frame's points and the map's error; with one camera, from the frame's points"
            " only, without drift.",
        ),
        ("Time per frame", Line("", numbers, ms), "ms", _time_words(ms)),
    )
    rendered = [(title, draw_lines([line], span, label), words) for title, line, label, words in charts]
    return [row for row in rendered if row[1]]


def _time_words(ms: np.ndarray) -> str:
    """Percentiles of the time per frame."""
    names = ("median", *(f"{p} %" for p in PERCENTILES[1:-1]), "longest")
    given = ", ".join(f"{name} {value:.1f}" for name, value in zip(names, np.percentile(ms, PERCENTILES)))
    return (
        f"{given} ms. Includes tracking, keyframe insertion and local bundle adjustment; excludes reading files and"
        " compilation in a first run."
    )


def _num_points(record: FrameRecord) -> float:
    if record.answer is None or record.answer.world_from_body is None:
        return float("nan")
    return float(record.answer.num_points)


def _span(records: Sequence[FrameRecord]) -> tuple[float, float]:
    return (0.0, float(max(len(records) - 1, 1)))
