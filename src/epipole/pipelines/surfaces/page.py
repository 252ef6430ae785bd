"""The report of a surface: depth of some views, why pixels have none, and a sample of the cloud."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from epipole.dense.fusion import DensePoints
from epipole.image import color_map
from epipole.pipelines.surfaces.depth_stage import depth_in
from epipole.pipelines.surfaces.inputs import SurfaceInputs
from epipole.pipelines.surfaces.results import DepthFigures
from epipole.pipelines.surfaces.survey_page import survey_images, survey_rows
from epipole.pipelines.surfaces.survey_stage import Survey
from epipole.pipelines.surfaces.view_files import view_of_file
from epipole.report.frame import render
from epipole.report.images import color_range_text, jpeg_uri
from epipole.report.markup import count, number
from epipole.report.space import SpaceData, space_data
from epipole.report.space_model import MAX_POINTS
from epipole.report.space_scene import METERS, NO_UNIT, FirstView, PointLayer, PointMeasure, SpaceScene
from epipole.runs import Unit
from epipole.scene.view_depth import DepthReason

MOST_VIEWS = 4
"""Views whose images are shown, evenly spaced over all."""
REASONS = {
    DepthReason.OK: ("known", (60, 160, 90)),
    DepthReason.OUT_OF_VIEW: ("no source shows it", (110, 110, 110)),
    DepthReason.OCCLUDED: ("hidden in the sources, or not confirmed by them", (240, 150, 40)),
    DepthReason.TEXTURELESS: ("no texture", (80, 190, 240)),
    DepthReason.AMBIGUOUS: ("several depths fit, or an isolated small region", (240, 220, 70)),
    DepthReason.DISAGREEING: ("too few sources have the same depth", (210, 50, 50)),
    DepthReason.UNCERTAIN: ("too large a standard deviation", (170, 80, 200)),
    DepthReason.MASKED: ("masked", (30, 30, 30)),
}
"""Words and color of each reason."""


def render_page(
    inputs: SurfaceInputs,
    depths: Mapping[int, Unit],
    figures: DepthFigures,
    sample: DensePoints | None,
    summary: Mapping[str, Any],
    survey: Survey | None = None,
) -> str:
    """One self-contained HTML page.

    Args:
        inputs: the views.
        depths: the unit of each view's depth.
        figures: figures of the depths.
        sample: some points of the cloud; None without a cloud.
        summary: the numbers of `summary.json`.
        survey: rasters of the survey products; None without them.
    """
    order = np.argsort(figures.density, kind="stable")
    return render(
        __package__,
        "surface.html.jinja",
        title="Surface",
        lead=f"Depth of {count(summary['num_views'])} views of {count(summary['num_images'])} images, by matching each with {_sources(inputs)} others.",
        tiles=_tiles(summary),
        warnings=list(summary["warnings"]),
        space=_space(inputs, sample),
        survey=None if survey is None else survey_images(survey),
        survey_rows=None if survey is None else survey_rows(survey, inputs.accuracy),
        views=[_images(inputs, depths, k) for k in _shown(list(depths))],
        reasons=_reasons(figures),
        rows=[_row(figures, k) for k in order.tolist()],
    )


def _sources(inputs: SurfaceInputs) -> str:
    numbers = sorted({len(inputs.sources[k]) for k in inputs.usable})
    return str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"


def _tiles(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Name, value and unit of the key figures."""
    out = [("Pixels with a depth", f"{100 * summary['density']:.0f}", "%")]
    if summary["relative_sigma"] is not None:
        out.append(("Median standard deviation", f"{100 * summary['relative_sigma']:.2g}", "% of the depth"))
    if "num_points" in summary:
        out.append(("Points", count(summary["num_points"]), ""))
    if "num_faces" in summary:
        out.append(("Triangles", count(summary["num_faces"]), ""))
    if "texture_size_px" in summary:
        out.append(("Texture", " x ".join(map(str, summary["texture_size_px"])), "px"))
    return out


def _space(inputs: SurfaceInputs, sample: DensePoints | None) -> SpaceData | None:
    """The sample in 3D, seen from the middle camera."""
    if sample is None or not len(sample):
        return None
    is_enu = inputs.model.georeference is not None
    unit = METERS if is_enu else NO_UNIT
    measure = PointMeasure("standard deviation", sample.sigma.astype(np.float64), unit)
    layer = PointLayer("Points", sample.points_in_world, sample.rgb, (measure,))
    view = inputs.views[inputs.usable[len(inputs.usable) // 2]]
    position, (_, down, ahead) = view.cam_from_world.centers(), view.cam_from_world.rotation
    distance = max(float(np.median((sample.points_in_world - position) @ ahead)), 1e-6)
    first = FirstView(position - 0.3 * distance * ahead, position + distance * ahead, -down)
    scene = SpaceScene("Surface", f"{count(len(sample))} points", unit, (layer,), view=first, is_enu=is_enu)
    return space_data(scene, MAX_POINTS)


def _shown(views: list[int]) -> list[int]:
    """A few of the views, evenly spaced."""
    rows = np.unique(np.linspace(0, len(views) - 1, MOST_VIEWS).round().astype(np.int64))
    return [views[row] for row in rows.tolist()]


def _images(inputs: SurfaceInputs, depths: Mapping[int, Unit], k: int) -> tuple[str, list[tuple[str, str]]]:
    """Name of a view; captions and images of its depth."""
    found = depth_in(depths[k].path)
    colors = np.array([REASONS[reason][1] for reason in DepthReason], np.uint8)
    images = [("image", jpeg_uri(view_of_file(inputs.views[k]).rgb))]
    if (found.depth > 0).any():
        percent = 100.0 * found.sigma / found.depth
        images += [
            (f"depth, {color_range_text(found.depth)}", jpeg_uri(color_map(found.depth))),
            (
                f"standard deviation in % of the depth, {color_range_text(percent)}",
                jpeg_uri(color_map(percent)),
            ),
        ]
    images.append(("known pixels, and reasons for the others", jpeg_uri(colors[found.reason])))
    return inputs.views[k].name, images


def _reasons(figures: DepthFigures) -> list[tuple[str, str, str]]:
    mean = figures.reasons.mean(axis=0)
    return [
        (f"rgb({red},{green},{blue})", words, f"{100 * mean[reason]:.1f}")
        for reason, (words, (red, green, blue)) in REASONS.items()
    ]


def _row(figures: DepthFigures, k: int) -> tuple[str, str, str]:
    sigma = figures.relative_sigma[k]
    return (
        figures.names[k],
        f"{100 * figures.density[k]:.0f}",
        number(100 * float(sigma), 3) if np.isfinite(sigma) else "",
    )
