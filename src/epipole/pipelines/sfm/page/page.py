"""The report of a reconstruction: values for its template, in reading order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from epipole.pipelines.sfm.page.content import ReportContent
from epipole.pipelines.sfm.page.images import image_lines
from epipole.pipelines.sfm.page.notes import notes_of
from epipole.pipelines.sfm.page.pairs import pair_lines
from epipole.pipelines.sfm.page.statistics import Statistics, statistics_of
from epipole.report.charts import Histogram, draw_histogram, draw_timings, histogram_of, histogram_of_integers
from epipole.report.frame import render
from epipole.report.markup import count, number, plural, seconds
from epipole.report.match_matrix import match_matrix_payload
from epipole.report.plan import draw_plan
from epipole.report.space import SpaceData, space_data
from epipole.report.space_model import MAX_POINTS, scene_of_model
from epipole.report.space_scene import METERS, NO_UNIT


def render_report(content: ReportContent) -> str:
    """One self-contained HTML page, without external files, fonts or scripts."""
    model, graph = content.reconstruction, content.view_graph
    statistics = statistics_of(model)
    is_registered = model.is_registered()
    total = max(len(content.image_rows), statistics.num_images)
    return render(
        __package__,
        "reconstruction.html.jinja",
        title=content.title,
        statistics=statistics,
        total=total,
        tiles=_tiles(content, statistics, total),
        notes=notes_of(content, statistics),
        model=_space(content) if is_registered.any() else None,
        plan=draw_plan(model, content.unit),
        num_pairs=len(graph),
        pairs=match_matrix_payload(graph, is_registered),
        most_inliers=int(graph.num_inliers().max(initial=0)),
        histograms=_histograms(statistics),
        with_models=bool(content.other_components),
        images=image_lines(content),
        contradicting=pair_lines(content),
        num_contradicting=len(content.contradicting),
        camera_lines=content.camera_lines,
        timings=draw_timings(content.timings) if content.timings else None,
        total_seconds=sum(content.timings.values()),
        compile_seconds=content.compile_seconds,
        settings=list(_flat(content.settings)),
        names=[str(name) for name in model.images.name],
    )


def _space(content: ReportContent) -> SpaceData:
    unit = METERS if content.is_metric else NO_UNIT
    return space_data(scene_of_model(content.reconstruction, title=content.title, unit=unit), MAX_POINTS)


def _tiles(content: ReportContent, statistics: Statistics, total: int) -> list[tuple[str, str, str]]:
    """Name, value and unit of the key figures."""
    has_errors = len(statistics.error_px) > 0
    time = seconds(sum(content.timings.values())) if content.timings else number(float("nan"))
    return [
        ("Images registered", count(statistics.num_registered), f"of {count(total)}"),
        ("Points", count(statistics.num_points), ""),
        ("Observations", count(statistics.num_observations), ""),
        ("Mean reprojection error", number(statistics.mean_error_px), "px" if has_errors else ""),
        ("Mean track length", number(statistics.mean_track_length), ""),
        ("Time", time, ""),
        *((name, value, "") for name, value in content.truth_errors.items()),
    ]


def _histograms(statistics: Statistics) -> list[tuple[str, object, str]]:
    """Title, chart and caption of each distribution; empty for a model without observations."""
    if not statistics.num_observations:
        return []
    angles = np.rad2deg(statistics.finite_angle_rad)
    charts = (
        ("Reprojection error", histogram_of(statistics.error_px, "pixels, per observation"), 2),
        ("Track length", histogram_of_integers(statistics.track_length, "images that see a point"), 0),
        ("Triangulation angle", histogram_of(angles, "degrees, largest of each point"), 1),
    )
    return [(title, draw_histogram(chart, digits), _shown(chart)) for title, chart, digits in charts]


def _shown(histogram: Histogram) -> str:
    beyond = f"; {count(histogram.num_beyond)} beyond the right edge" if histogram.num_beyond else ""
    return f"{plural(int(histogram.counts.sum()), 'value')} shown{beyond}"


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Nested settings as dotted names and plain values, in order."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", str(value)
