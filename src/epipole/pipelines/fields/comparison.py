"""The job: Gaussians and a field that is marched through, trained for the same time on the same pictures and compared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from epipole.fields.config import NerfConfig, SplatConfig
from epipole.fields.rasterizer import render as draw
from epipole.fields.rasterizer import useful_pairs
from epipole.fields.training_view import TrainingView
from epipole.io.rgba_pictures import write_png
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.kinds import KINDS
from epipole.pipelines.fields.nerf import NerfResult, nerf
from epipole.pipelines.fields.page import drawn_name
from epipole.pipelines.fields.run import SplatResult, splat
from epipole.pipelines.fields.scores import scores_of
from epipole.pipelines.fields.training import MODEL, background_of, called, pictures_of
from epipole.runs import ProgressCallback, Run, ignore_progress, open_run

PICTURES, FIGURES = "pictures", "compare.json"
SPLAT, NERF = "splat", "nerf"

Drawn = tuple[np.ndarray, Callable[[], dict[str, float]]]
"""A picture, and what counts its pixels' work afterwards."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldComparison:
    """Likeness, speed, and work for each pixel."""

    out: Path
    rows: dict[str, dict[str, Any]]
    """Of `splat` and `nerf`: psnr, ssim, train_s, frames_s; evaluated and useful pairs a pixel, or queries a pixel."""
    warnings: tuple[str, ...]
    is_interrupted: bool


def compare_fields(
    source: str | Path,
    out: str | Path,
    config: NerfConfig | None = None,
    job: FieldOptions | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Any,
) -> FieldComparison:
    """Train Gaussians, and a neural field or a grid, for the same time, and draw the same views with both.

    Views that were held out are compared; where none were, those that were trained on.

    Args:
        source: as of `splat`.
        out: output folder: `splat`, `nerf`, `pictures/NAME.png` (truth, Gaussians, field), `compare.json`.
        config: which field Gaussians are compared with; None for the neural one. Its seed is that of both.
        job: which pictures, and for how long each is trained.
        progress: called with the progress of each stage.
        **options: single options of both by name, which override them: `time="1m"`.

    Raises:
        NoModelError: the pictures give no cameras, or fewer than two can be used.
        ConfigError: an option is unknown or makes no sense.
        DegenerateGeometryError: the cameras see nothing in common, or look the same way.
        FileFormatError: the source cannot be read.
        WorkspaceError: the output folder cannot be used.
    """
    given = called("compare-fields", (source, out), (NerfConfig, config), job, progress, options)
    source, wanted, config = given.source, given.pictures, given.config
    with open_run(given.task, given.out) as run:
        gaussians = splat(source, run.root / SPLAT, SplatConfig(seed=config.seed), wanted, progress)
        model = gaussians.out / MODEL
        field = nerf(model if model.is_dir() else source, run.root / NERF, config, wanted, progress)
        pictures = pictures_of(model if model.is_dir() else source, run, wanted)
        views, background = pictures.test or pictures.train, background_of(wanted, pictures)
        rows = _compared(_drawers(gaussians, field, config, background), views, background, run)
        for name, result in ((SPLAT, gaussians), (NERF, field)):
            rows[name]["train_s"] = result.summary["train_s"]
        rows[SPLAT]["num_gaussians"] = len(gaussians.cloud)
        run.warnings = list(dict.fromkeys([*gaussians.warnings, *field.warnings, *run.warnings]))
        told = {"kind": config.kind, "held_out": bool(pictures.test), "views": len(views), **rows}
        told["frames_ratio"] = rows[SPLAT]["frames_s"] / rows[NERF]["frames_s"]
        told["warnings"] = run.warnings
        run.folder.write_json(FIGURES, told)
        is_interrupted = gaussians.summary["interrupted"] or field.summary["interrupted"]
        run.finish(told)
        return FieldComparison(run.root, rows, tuple(run.warnings), is_interrupted)


def _drawers(
    gaussians: SplatResult, field: NerfResult, config: NerfConfig, background: np.ndarray
) -> dict[str, Callable[[TrainingView], Drawn]]:
    kind = KINDS[config.kind]

    def splatted(view: TrainingView) -> Drawn:
        drawn = draw(gaussians.cloud, view.camera, view.cam_from_world)
        return drawn.over(background), lambda: {
            "evaluated": drawn.tiles.num_evaluated,
            "useful": useful_pairs(drawn),
        }

    def marched(view: TrainingView) -> Drawn:
        picture, _, queries = kind.draw(field.field, view.camera, view.cam_from_world, background)
        return picture, lambda: {"queries": queries}

    return {SPLAT: splatted, NERF: marched}


def _compared(
    drawers: dict[str, Callable[[TrainingView], Drawn]],
    views: Sequence[TrainingView],
    background: np.ndarray,
    run: Run,
) -> dict[str, dict[str, Any]]:
    """Means of all views, which are written side by side."""
    scores: dict[str, list[dict[str, float]]] = {name: [] for name in drawers}
    for drawer in drawers.values():
        drawer(views[0])  # compiled, and in the caches
    with run.stage("compare"), run.folder.publish(PICTURES) as aside:
        for n, view in enumerate(views):
            truth = view.over(background)
            beside = [truth]
            for name, drawer in drawers.items():
                begin = perf_counter()
                picture, work = drawer(view)
                seconds = perf_counter() - begin
                beside.append(picture)
                told = {**scores_of(picture, view, background), "s": seconds}
                each = {part: count / truth[..., 0].size for part, count in work().items()}
                scores[name].append({**told, **each})
            whole = np.rint(255 * np.clip(np.hstack(beside), 0, 1)).astype(np.uint8)
            write_png(aside / PICTURES / drawn_name(view.name), whole)
            run.report("compare", n + 1, len(views))
    means = {
        name: {part: float(np.mean([one[part] for one in rows])) for part in rows[0]}
        for name, rows in scores.items()
    }
    for row in means.values():
        row["frames_s"] = 1.0 / row.pop("s")
    return means
