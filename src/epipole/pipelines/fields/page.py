"""The report of a trained field: held-out views next to their images, PSNR over time, counts and timings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from epipole.fields.training_view import TrainingView
from epipole.image import color_map
from epipole.io.images.photographs import read_rgb
from epipole.io.names import flat_names
from epipole.pipelines.fields.images import FieldImages
from epipole.report.charts import draw_curves, draw_timings
from epipole.report.frame import render
from epipole.report.images import jpeg_uri
from epipole.report.space import space_data
from epipole.report.space_scene import SpaceScene

MOST_VIEWS = 8
"""Views that are shown, at most, evenly spaced."""
LARGEST_ERROR = 0.25
"""Error at the end of the color scale, as a fraction of white."""
MOST_GAUSSIANS = 30_000
"""Gaussians in the 3D view of the page; more are merged."""
COUNTS = {"num_gaussians": "Gaussians", "num_voxels": "voxel corners", "num_parameters": "parameters"}


@dataclass(frozen=True, slots=True, eq=False)
class FieldPage:
    """Contents of the page."""

    summary: dict[str, Any]
    scores: list[dict[str, Any]]
    images: FieldImages
    background: np.ndarray
    tables: dict[str, dict[str, list[Any]]]
    root: Path
    scene: SpaceScene | None
    """Gaussians, or points on the surfaces of a radiance field; None if there are none."""
    warnings: Sequence[str]


@dataclass(frozen=True, slots=True)
class _View:
    name: str
    psnr: str
    ssim: str
    images: list[tuple[str, str]]
    """Caption and data URI of image, render and error."""


def rendered_names(views: Sequence[TrainingView]) -> dict[str, str]:
    """File name of the render of each held-out view, which does not depend on how many are rendered."""
    names = [view.name for view in views]
    return {name: f"{file}.png" for name, file in zip(names, flat_names(names))}


def render_page(page: FieldPage) -> str:
    """One self-contained HTML page."""
    summary = page.summary
    rows = np.unique(np.linspace(0, len(page.scores) - 1, MOST_VIEWS).astype(np.int64)).tolist()
    views, files = {view.name: view for view in page.images.test}, rendered_names(page.images.test)
    chosen = [page.scores[row] for row in rows if page.scores]
    shown = [_view(page, views[score["name"]], files[score["name"]], score) for score in chosen]
    return render(
        __package__,
        "field.html.jinja",
        title="Gaussian splat" if "num_gaussians" in summary else "Radiance field",
        psnr=None if summary["psnr"] is None else f"{summary['psnr']:.1f}",
        space=None if page.scene is None else space_data(page.scene, most_gaussians=MOST_GAUSSIANS),
        warnings=list(page.warnings),
        figures=_figures(summary),
        curves=_curves(page),
        views=shown,
        num_views=len(page.scores),
        largest_error=f"{100 * LARGEST_ERROR:.0f}",
        timings=draw_timings(summary["timings_s"]),
    )


def _figures(summary: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [(words, f"{summary[name]:,}") for name, words in COUNTS.items() if name in summary]
    rows += [
        ("training images", str(summary["num_train"])),
        ("held-out images", str(summary["num_test"])),
        ("steps", f"{summary['steps']:,}"),
        ("training time, s", f"{summary['train_s']:.1f}"),
        ("background", summary["background"]),
    ]
    if summary["psnr"] is not None:
        rows += [
            ("PSNR, dB", f"{summary['psnr']:.2f}"),
            ("PSNR after color matching, dB", f"{summary['psnr_matched']:.2f}"),
            ("SSIM", f"{summary['ssim']:.4f}"),
        ]
    return rows


def _curves(page: FieldPage) -> list[Any]:
    columns = list(zip(*page.tables["curve"]["rows"])) or [(), (), (), ()]
    charts = []
    held_out = [*page.tables["held_out"]["rows"]]
    if held_out:
        if page.summary["psnr"] is not None:
            held_out.append([page.summary["train_s"], page.summary["steps"], page.summary["psnr"]])
        seconds, _, psnr = zip(*held_out)
        charts.append(draw_curves({"held out": (seconds, psnr)}, "seconds", "PSNR, dB", even_y=True))
    charts.append(draw_curves({"loss": (columns[0], columns[2])}, "seconds", "training loss"))
    return charts


def _view(page: FieldPage, view: TrainingView, file: str, score: dict[str, Any]) -> _View:
    truth = np.rint(255 * view.over(page.background)).astype(np.uint8)
    charts = read_rgb(page.root / "test" / file)
    error = np.abs(charts.astype(np.float64) - truth).mean(axis=2) / 255
    heat = color_map(error, (0.0, LARGEST_ERROR))
    captions = ("image", "render", "error")
    sources = [jpeg_uri(one) for one in (truth, charts, heat)]
    return _View(view.name, f"{score['psnr']:.2f}", f"{score['ssim']:.3f}", list(zip(captions, sources)))
