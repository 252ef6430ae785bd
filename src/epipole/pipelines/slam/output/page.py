"""Report page of a SLAM run: the values that its template shows, in reading order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from epipole.pipelines.slam.output.page_frames import frame_charts, keyframe_reasons, state_strip
from epipole.pipelines.slam.output.record import FrameRecord, stretches
from epipole.pipelines.slam.output.rendering import (
    CAUSAL,
    CAUSAL_RGB,
    FINAL,
    FINAL_RGB,
    TRUTH,
    TRUTH_GAP,
    TRUTH_RGB,
    loop_curve,
    path_curve,
    upright_from_world,
)
from epipole.pipelines.slam.output.truth import PathErrors, errors_of
from epipole.report.charts import draw_timings
from epipole.report.frame import render
from epipole.report.markup import count, number
from epipole.report.path_plan import draw_path_plan
from epipole.report.series import Line, draw_lines
from epipole.report.space import space_data
from epipole.report.space_model import MAX_POINTS, scene_of_model
from epipole.report.space_scene import METERS, NO_UNIT, SpaceScene
from epipole.scene import Curve, Reconstruction, Trajectory

MOST_STRETCHES = 40
"""Largest number of rows in the table of states."""
MOST_LOOPS = 200
"""Largest number of rows in the table of loops."""


@dataclass(frozen=True, slots=True, eq=False)
class SlamPage:
    """Content of the page."""

    title: str
    summary: Mapping[str, Any]
    """As in `summary.json`; `loops` and `truth` may be absent."""
    records: Sequence[FrameRecord]
    model: Reconstruction
    """Its images are the keyframes."""
    final: Trajectory
    causal: Trajectory
    truth: Trajectory | None
    settings: Mapping[str, Any]
    timings: Mapping[str, float]

    @property
    def is_metric(self) -> bool:
        """Whether lengths are meters."""
        return bool(self.summary["is_metric"])

    @property
    def unit(self) -> str:
        """Unit of lengths in the map."""
        return "m" if self.is_metric else "map units, up to scale"


def render_page(page: SlamPage) -> str:
    """Render a self-contained HTML page."""
    errors = _errors(page)
    upright = upright_from_world(page.final.world_from_body)
    curves = [curve.transformed(upright) for curve in _curves(page, errors)]
    model = page.model.transformed(upright)
    positions = page.final.world_from_body.translation
    loops = page.summary.get("loops") or []
    return render(
        __package__,
        "slam.html.jinja",
        title=page.title,
        summary=page.summary,
        is_metric=page.is_metric,
        unit=page.unit,
        length=page.final.path_length(),
        tiles=_tiles(page),
        warnings=page.summary["warnings"],
        has_truth=page.truth is not None,
        model=space_data(_scene(page, model, curves), MAX_POINTS) if _shows_anything(model, curves) else None,
        num_points=len(model.points),
        plan=draw_path_plan(curves, model.points.xyz_in_world, upright.apply(positions[[0, -1]]), page.unit),
        strip=state_strip(page.records),
        stretches=stretches(page.records)[:MOST_STRETCHES],
        num_stretches_left=max(len(stretches(page.records)) - MOST_STRETCHES, 0),
        keyframe_reasons=keyframe_reasons(page.records),
        charts=frame_charts(page.records, page.unit),
        scores=_scores(page),
        error_chart=_error_chart(page, errors),
        truth_source=(page.summary.get("truth") or {}).get("source", ""),
        loops=loops[:MOST_LOOPS],
        num_loops=len(loops),
        submaps=page.summary.get("submaps") or [],
        num_accepted=sum(loop.get("verdict") == "accepted" for loop in loops),
        timings=draw_timings(page.timings),
        total_seconds=sum(page.timings.values()),
        settings=list(_flat(page.settings)),
        names=[str(name) for name in model.images.name],
    )


def _shows_anything(model: Reconstruction, curves: Sequence[Curve]) -> bool:
    """Whether there is a keyframe, a point or a path; a camera that stands still may have none."""
    return bool(
        len(model.images) or len(model.points) or any(len(curve.segments_in_world) for curve in curves)
    )


def _scene(page: SlamPage, model: Reconstruction, curves: Sequence[Curve]) -> SpaceScene:
    unit = METERS if page.is_metric else NO_UNIT
    return scene_of_model(model, title=page.title, unit=unit, cameras="Keyframes", curves=curves)


def _errors(page: SlamPage) -> tuple[PathErrors | None, PathErrors | None]:
    """Errors of the final and of the causal trajectory."""
    if page.truth is None:
        return None, None
    with_scale = not page.is_metric
    return (
        errors_of(page.final, page.truth, with_scale=with_scale),
        errors_of(page.causal, page.truth, with_scale=with_scale),
    )


def _curves(page: SlamPage, errors: tuple[PathErrors | None, PathErrors | None]) -> list[Curve]:
    """Final, causal and true trajectory and loops, in the color order of the charts."""
    out = [
        path_curve(FINAL, page.final, FINAL_RGB),
        path_curve(CAUSAL, page.causal, CAUSAL_RGB, is_shown=False),
    ]
    known = Curve(TRUTH, np.zeros((0, 2, 3)), TRUTH_RGB)
    if page.truth is not None and errors[0] is not None:
        span = page.final.timestamp_s[[0, -1]]
        rows = np.flatnonzero(
            (page.truth.timestamp_s >= span[0] - 0.5) & (page.truth.timestamp_s <= span[1] + 0.5)
        )
        known = path_curve(TRUTH, page.truth[rows], TRUTH_RGB, TRUTH_GAP).transformed(
            errors[0].estimate_from_truth
        )
    names = set(page.model.images.name)
    frames = [record.number for record in page.records if record.name in names]
    return [*out, known, loop_curve(page.summary.get("loops") or [], page.model, frames)]


def _tiles(page: SlamPage) -> list[tuple[str, str, str]]:
    """Name, value and unit of the headline numbers."""
    summary = page.summary
    tiles = [
        ("Localized frames", count(summary["num_localized"]), f"of {count(summary['num_frames'])}"),
        ("Keyframes", count(summary["num_keyframes"]), ""),
        ("Points", count(summary["num_points"]), ""),
        ("Mean reprojection error", number(_or_nan(summary["mean_reprojection_error_px"])), "px"),
        ("Trajectory length", f"{page.final.path_length():.4g}", "m" if page.is_metric else "up to scale"),
        ("Time per frame", number(summary["ms_per_frame"]["median"], 1), "ms, median"),
    ]
    final = (summary.get("truth") or {}).get("final")
    if final is not None:
        kind = "rigid" if page.is_metric else "similarity"
        words = "SE(3)" if page.is_metric else "Sim(3)"
        tiles.append(("Error (ATE, rmse)", f"{final[kind]['ate_rmse']:.3g}", words))
    return tiles


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value


def _scores(page: SlamPage) -> list[tuple[str, str, list[str], bool]]:
    """Rows of the error table: trajectory, alignment, numbers, and whether the row is highlighted."""
    rows = []
    for name, words in (("final", FINAL), ("causal", CAUSAL)):
        found = (page.summary.get("truth") or {}).get(name)
        if found is None:
            continue
        for kind, alignment in (("rigid", "SE(3)"), ("similarity", "Sim(3)")):
            score = found[kind]
            percent = score["kitti_percent"]
            numbers = [
                *(f"{score[key]:.3g}" for key in ("ate_rmse", "ate_median", "ate_max")),
                f"{score['scale']:.4f}",
                f"{score['rotation_rmse_deg']:.3g}",
                f"{score['step_rmse']:.3g}",
                f"{found['step_rotation_rmse_deg']:.3g}",
                "\N{EN DASH}" if percent is None else f"{percent:.3f}",
                f"{100 * found['coverage']:.1f} %",
            ]
            rows.append((words, alignment, numbers, page.is_metric == (kind == "rigid")))
    return rows


def _error_chart(page: SlamPage, errors: tuple[PathErrors | None, PathErrors | None]) -> Markup:
    """Chart of each frame's distance from the truth."""
    given = [(r.answer.timestamp_s, r.number) for r in page.records if r.answer is not None]
    times, numbers = (np.array(column, np.float64) for column in zip(*given))
    lines = []
    for name, color, found in ((FINAL, "accent", errors[0]), (CAUSAL, "soft", errors[1])):
        if found is not None:
            y = np.full(len(times), np.nan)
            y[np.searchsorted(times, found.timestamp_s)] = found.distance
            lines.append(Line(name, numbers, y, color))
    unit = "in the truth's unit"
    return draw_lines(lines, (0.0, float(len(page.records) - 1)), unit)


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Nested settings as dotted names and plain values, in order."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", str(value)
