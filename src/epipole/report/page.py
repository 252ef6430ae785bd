"""The page: sections in reading order, put together into one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from epipole.report.charts import draw_histogram, draw_timings, histogram_of, histogram_of_integers
from epipole.report.content import ReportContent
from epipole.report.frame import content_hash, joined
from epipole.report.markup import count, escape, json_block, number, plural, seconds
from epipole.report.notes import notes_of
from epipole.report.pictures import draw_pictures
from epipole.report.plan import draw_plan
from epipole.report.space import space_payload
from epipole.report.statistics import Statistics, statistics_of
from epipole.robust import PairKind
from epipole.scene import Reconstruction, ViewGraph

# The browser itself refuses to load anything from outside the page, and to run any script but the page's own.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src '{}'"
_SCRIPTS = ("page.js", "match_matrix.js", "space.js", "end.js")


def render_report(content: ReportContent) -> str:
    """One HTML page with everything inside it: no file, font or script from elsewhere."""
    statistics = statistics_of(content.reconstruction)
    body = "".join(
        (
            _header(content, statistics),
            _notes(content, statistics),
            _space(content.reconstruction),
            f'<div class="two">{_plan(content)}{_matrix(content)}</div>',
            _histograms(statistics),
            _pictures(content),
            _cameras(content),
            _timings(content),
            _settings(content),
            f"<footer>Made by epipole {escape(content.version)}. "
            "This page is one file and loads nothing.</footer>",
        )
    )
    names = [str(name) for name in content.reconstruction.images.name]
    style, script = joined(("page.css",)), joined(_SCRIPTS)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY.format(content_hash(script))}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(content.title)}</title><style>{style}</style></head>\n"
        f'<body><main>{body}</main><div id="tip" hidden></div><dialog id="enlarged"></dialog>'
        f"{json_block('names', names)}<script>{script}</script></body></html>\n"
    )


def _section(title: str, content: str, explanation: str = "") -> str:
    words = f'<p class="soft">{explanation}</p>' if explanation else ""
    return f"<section><h2>{title}</h2>{words}{content}</section>"


def _header(content: ReportContent, statistics: Statistics) -> str:
    total = max(len(content.image_rows), statistics.num_images)
    error = number(statistics.mean_error_px)
    tiles = [
        ("Pictures placed", f"{count(statistics.num_registered)} <small>of {count(total)}</small>"),
        ("Points", count(statistics.num_points)),
        ("Observations", count(statistics.num_observations)),
        ("Mean reprojection error", f"{error} <small>px</small>" if len(statistics.error_px) else error),
        ("Mean track length", number(statistics.mean_track_length)),
        ("Time", seconds(sum(content.timings.values())) if content.timings else number(float("nan"))),
    ]
    tiles += [(escape(name), escape(value)) for name, value in content.truth_errors.items()]
    numbers = "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in tiles)
    lead = (
        f"{count(statistics.num_registered)} of {plural(total, 'picture')} placed in one model of "
        f"{plural(statistics.num_points, 'point')}."
        if statistics.num_registered
        else f"No model could be made from {plural(total, 'picture')}."
    )
    title = f'<header><h1>{escape(content.title)}</h1><p class="lead">{lead}</p></header>'
    return f'{title}<dl class="numbers">{numbers}</dl>'


def _notes(content: ReportContent, statistics: Statistics) -> str:
    items = "".join(
        f'<li class="{level}">{escape(text)}</li>'
        for text, level in ((t, "warn" if w else "plain") for t, w in notes_of(content, statistics))
    )
    return _section("What to know about this model", f'<ul class="notes">{items}</ul>')


def _space(reconstruction: Reconstruction) -> str:
    if not reconstruction.is_registered().any():
        return _section("The model", '<div class="empty">There is no model to show.</div>')
    payload = space_payload(reconstruction)
    num_points = len(reconstruction.points)
    shown = f"{count(payload['count'])} of {plural(num_points, 'point')}"
    tools = (
        '<div class="tools">'
        '<label>Points <input id="point-size" type="range" min="1" max="6" step="0.5" value="2"></label>'
        '<label>Frusta <input id="frustum-size" type="range" min="0.2" max="4" step="0.1" value="1"></label>'
        '<label><input id="show-cameras" type="checkbox" checked> Cameras</label>'
        '<button type="button" id="view-above">From above</button>'
        '<button type="button" id="reset-view">Reset</button>'
        '<button type="button" id="full-screen">Full screen</button></div>'
    )
    return _section(
        "The model",
        '<div class="stage"><canvas id="space" tabindex="0" aria-label="3D view of points and cameras">'
        f"</canvas>{tools}</div>{json_block('model', payload)}",
        f"{shown} and every camera. Drag to turn, shift-drag or two fingers to move, "
        "click and then scroll or pinch to zoom. Click a camera to look from it.",
    )


def _plan(content: ReportContent) -> str:
    drawing = draw_plan(content.reconstruction, content.unit)
    figure = (
        f'<figure class="panel">{drawing}</figure>'
        if drawing
        else '<div class="empty">No camera has a place.</div>'
    )
    return _section(
        "From above",
        figure,
        "Cameras with their viewing directions over the density of points. The line joins pictures that "
        "follow each other by name.",
    )


def _matrix(content: ReportContent) -> str:
    graph = content.view_graph
    pairs = plural(len(graph), "verified pair")
    explanation = f"Inlier matches of {pairs}; pictures are numbered in the order of names."
    if not len(graph):
        return _section(
            "Matches", '<div class="empty">No pair of pictures could be verified.</div>', explanation
        )
    most = int(graph.num_inliers().max())
    legend = f'<div class="ramp">1<i></i>{count(most)} inliers, logarithmic<b></b>not placed</div>'
    return _section(
        "Matches",
        f'<figure class="panel matrix"><canvas id="matrix"></canvas>{legend}</figure>'
        + json_block("pairs", _pairs(graph, content.reconstruction)),
        explanation,
    )


def _pairs(graph: ViewGraph, reconstruction: Reconstruction) -> dict[str, Any]:
    angles = np.rad2deg(graph.median_angle_rad)
    return {
        "n": len(reconstruction.images),
        "placed": np.flatnonzero(reconstruction.is_registered()).tolist(),
        "first": graph.image1.tolist(),
        "second": graph.image2.tolist(),
        "count": graph.num_inliers().tolist(),
        "putative": graph.num_putative.tolist(),
        "kind": graph.kind.tolist(),
        "kinds": {str(int(kind)): kind.name.lower() for kind in PairKind},
        "angle": [round(float(a), 1) if np.isfinite(a) else None for a in angles],
    }


def _histograms(statistics: Statistics) -> str:
    if not statistics.num_observations:
        return ""
    angles = np.rad2deg(statistics.finite_angle_rad)
    charts = (
        ("Reprojection error", histogram_of(statistics.error_px, "pixels, per observation"), 2),
        ("Track length", histogram_of_integers(statistics.track_length, "pictures that see a point"), 0),
        ("Triangulation angle", histogram_of(angles, "degrees, the widest of each point"), 1),
    )
    panels = []
    for title, histogram, digits in charts:
        beyond = f"; {count(histogram.num_beyond)} further right" if histogram.num_beyond else ""
        shown = plural(int(histogram.counts.sum()), "value")
        panels.append(
            f'<figure class="panel"><h3>{title}</h3>{draw_histogram(histogram, digits)}'
            f'<figcaption class="soft">{shown} shown{beyond}</figcaption></figure>'
        )
    return _section("Distributions", f'<div class="three">{"".join(panels)}</div>')


def _pictures(content: ReportContent) -> str:
    if not content.image_rows:
        return _section("Pictures", '<div class="empty">There are no pictures.</div>')
    return _section(
        "Pictures",
        f'<div class="scroll">{draw_pictures(content)}</div>',
        "Dots mark features that see a point of the model. Click a heading to sort, a picture to enlarge it.",
    )


def _cameras(content: ReportContent) -> str:
    if not content.camera_lines:
        return ""
    lines = "".join(f"<li>{escape(line)}</li>" for line in content.camera_lines)
    return _section("Cameras", f'<ul class="cameras">{lines}</ul>')


def _timings(content: ReportContent) -> str:
    if not content.timings:
        return ""
    words = f"{seconds(sum(content.timings.values()))} in all."
    if content.compile_seconds > 0:
        words += (
            f" Of this, {seconds(content.compile_seconds)} went into compiling kernels, "
            "which happens once on a machine."
        )
    return _section("Time", f'<figure class="timings">{draw_timings(content.timings)}</figure>', words)


def _settings(content: ReportContent) -> str:
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(value)}</td></tr>'
        for name, value in _flat(content.settings)
    )
    if not rows:
        return ""
    table = f'<table class="settings"><tbody>{rows}</tbody></table>'
    return _section("Settings", f"<details><summary>Every setting of this run</summary>{table}</details>")


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Nested settings as dotted names and plain values, in order."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", str(value)
