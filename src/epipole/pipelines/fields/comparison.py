"""The `compare-fields` job: train Gaussians and a ray-marched field for the same time, and compare them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, Unpack

import numpy as np

from epipole._jit import compile_seconds
from epipole.fields.splat.numba_backend import useful_pairs
from epipole.fields.splat.rasterizer import render
from epipole.fields.training_view import TrainingView
from epipole.io.files import read_json
from epipole.io.images.photographs import read_rgb
from epipole.io.images.rgba import write_png
from epipole.pipelines.fields.config import FieldOptions, NerfConfig, SplatConfig
from epipole.pipelines.fields.held_out import in_time, timed
from epipole.pipelines.fields.images import FieldImages
from epipole.pipelines.fields.kinds import KINDS, Kind
from epipole.pipelines.fields.options import NerfKeywords
from epipole.pipelines.fields.page import rendered_names
from epipole.pipelines.fields.recipes import GaussianRecipe, RayRecipe
from epipole.pipelines.fields.rendering.renderer import in_bytes
from epipole.pipelines.fields.run import FieldResult, train_field
from epipole.pipelines.fields.scores import scores_of
from epipole.pipelines.fields.training import MEANS, METRICS, background_of, training_of
from epipole.runs import PassedExecutor, ProgressCallback, Run, ignore_progress, open_run

IMAGES, FIGURES = "images", "compare.json"
SPLAT, NERF = "splat", "nerf"


class Shown(NamedTuple):
    """A view, rendered and compared with its image."""

    image: np.ndarray
    row: dict[str, float]
    """PSNR and SSIM, seconds (`s`), and work per pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldComparison:
    """Quality, speed and work per pixel of both fields."""

    out: Path
    rows: dict[str, dict[str, Any]]
    """For `splat` and `nerf`: psnr, ssim, train_s, frames_s; per pixel, evaluated and useful pairs, or queries."""
    warnings: tuple[str, ...]
    is_interrupted: bool


def compare_fields(
    source: str | Path,
    out: str | Path,
    config: NerfConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    executor: PassedExecutor | None = None,
    **options: Unpack[NerfKeywords],
) -> FieldComparison:
    """Train Gaussians and a neural field (or a grid) for the same time, and render the same views with both.

    The views are the held-out ones or, if there are none, the training views. If a time is given, rendering takes at
    most a quarter of it, with an evenly spaced subset of the views if necessary.

    Args:
        source: as for `splat`.
        out: output folder: `splat`, `nerf`, `images/NAME.png` (image, Gaussians, field), `compare.json`.
        config: images, training time, and the field to compare with; both trainings use its seed.
        progress: called with the progress of each stage.
        executor: executor for images instead of the config's cluster, as for `reconstruct`.
        **options: single options by name, which override `config`: `time="1m"`.

    Raises:
        NoModelError: the images cannot be reconstructed, or fewer than two can be used.
        ConfigError: an option is unknown or invalid.
        DegenerateGeometryError: the cameras see nothing in common, or all look in the same direction.
        FileFormatError: the source cannot be read.
        WorkspaceError: the output folder cannot be used.
    """
    given = training_of("compare-fields", (source, out), (NerfConfig, config), progress, options, executor)
    source, wanted = given.source, given.config
    shared = {name.name: getattr(wanted, name.name) for name in fields(FieldOptions)}
    with open_run(given.task, given.out) as run:
        work = run.job.executor
        of_splat = (SplatConfig, SplatConfig(seed=wanted.seed, **shared))
        splat = training_of(SPLAT, (source, run.root / SPLAT), of_splat, progress, {}, work)
        gaussians, images = train_field(splat, GaussianRecipe(splat.config))
        nerf = training_of(NERF, (source, run.root / NERF), (NerfConfig, wanted), progress, {}, work)
        field, _ = train_field(nerf, RayRecipe(nerf.config), images)
        background = background_of(wanted, images)
        run.warnings = list(dict.fromkeys([*gaussians.warnings, *field.warnings]))
        views, marched = _of_field(field, KINDS[wanted.kind], images, wanted, run)
        views = [view for view in views if not images.test or view.name in _rows_of(gaussians.out)]
        splatted, files = partial(_splatted, gaussians, background), rendered_names(images.test or views)
        rows = _compared(splatted, marched, views, background, files, run)
        for name, result in ((SPLAT, gaussians), (NERF, field)):
            rows[name]["train_s"] = result.summary["train_s"]
        rows[SPLAT]["num_gaussians"] = len(gaussians.cloud)
        figures: dict[str, Any] = {
            "kind": wanted.kind,
            "held_out": bool(images.test),
            "views": len(views),
            **rows,
        }
        figures["frames_ratio"] = rows[SPLAT]["frames_s"] / rows[NERF]["frames_s"]
        figures["warnings"] = run.warnings
        run.folder.write_json(FIGURES, figures)
        is_interrupted = gaussians.summary["interrupted"] or field.summary["interrupted"]
        run.finish(figures)
        return FieldComparison(run.root, rows, tuple(run.warnings), is_interrupted)


@dataclass(frozen=True, slots=True, eq=False)
class _FieldRenderer:
    """A trained field."""

    background: np.ndarray
    result: FieldResult
    kind: Kind

    def render_counted(self, view: TrainingView) -> tuple[np.ndarray, int]:
        """Image of a view, and number of evaluations."""
        rendered, _, count = self.kind.render(
            self.result.field, view.camera, view.cam_from_world, self.background
        )
        return rendered, count


def _of_field(
    field: FieldResult, kind: Kind, images: FieldImages, wanted: FieldOptions, run: Run
) -> tuple[list[TrainingView], Callable[[TrainingView], Shown]]:
    """Views to compare, and a function that gives the field's render of each.

    Held-out views were already rendered by the field's job, which may take a minute each; training views are rendered
    here.
    """
    if images.test:
        rows, files = _rows_of(field.out), rendered_names(images.test)
        return [view for view in images.test if view.name in rows], partial(_read, field.out, files, rows)
    renderer = _FieldRenderer(background_of(wanted, images), field, kind)
    report = partial(run.report, "test")
    shown = in_time(images.train, wanted, partial(_rendered, renderer), report, run.warnings)
    by_name = {view.name: each for view, each in shown}
    return [view for view, _ in shown], lambda view: by_name[view.name]


def _rendered(renderer: _FieldRenderer, view: TrainingView) -> Shown:
    image, seconds, count = timed(renderer, view)
    scores = scores_of(image, view, renderer.background)
    return Shown(image, {**scores, "s": seconds, "queries": count / image[..., 0].size})


def _read(
    folder: Path, files: Mapping[str, str], rows: Mapping[str, Mapping[str, Any]], view: TrainingView
) -> Shown:
    """Render and scores written by the field's job."""
    image, row = read_rgb(folder / "test" / files[view.name]), rows[view.name]
    scores = {name: np.nan if row[name] is None else row[name] for name in MEANS}  # JSON has no NaN
    figures = {"s": row["render_s"], "queries": row["count"] / image[..., 0].size}
    return Shown(image.astype(np.float32) / np.float32(255.0), {**scores, **figures})


def _splatted(gaussians: FieldResult, background: np.ndarray, view: TrainingView) -> Shown:
    start, compiled = perf_counter(), compile_seconds()
    rendered = render(gaussians.cloud, view.camera, view.cam_from_world)
    image = rendered.over(background)
    seconds = perf_counter() - start - (compile_seconds() - compiled)
    pairs = {"evaluated": rendered.num_evaluated, "useful": useful_pairs(rendered)}
    each = {name: count / image[..., 0].size for name, count in pairs.items()}
    return Shown(image, {**scores_of(image, view, background), "s": seconds, **each})


def _rows_of(folder: Path) -> dict[str, dict[str, Any]]:
    """Metrics of the held-out views that a job has rendered, by name."""
    return {row["name"]: row for row in read_json(folder / METRICS)["views"]}


def _compared(
    splatted: Callable[[TrainingView], Shown],
    marched: Callable[[TrainingView], Shown],
    views: Sequence[TrainingView],
    background: np.ndarray,
    files: Mapping[str, str],
    run: Run,
) -> dict[str, dict[str, Any]]:
    """Mean scores of all views; writes the renders side by side."""
    scores: dict[str, list[dict[str, float]]] = {SPLAT: [], NERF: []}
    splatted(views[0])  # warms the caches
    run.report("compare", 0, len(views))
    with run.stage("compare"), run.folder.publish(IMAGES) as aside:
        for n, view in enumerate(views):
            beside = [view.over(background)]
            for name, shown in ((SPLAT, splatted(view)), (NERF, marched(view))):
                beside.append(shown.image)
                scores[name].append(shown.row)
            write_png(aside / IMAGES / files[view.name], in_bytes(np.hstack(beside)))
            run.report("compare", n + 1, len(views))
    means = {
        name: {part: float(np.mean([one[part] for one in rows])) for part in rows[0]}
        for name, rows in scores.items()
    }
    for row in means.values():
        row["frames_s"] = 1.0 / row.pop("s")
    return means
