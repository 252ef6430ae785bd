"""Code shared by all trainings of fields: images, clock, Ctrl-C, and comparison with held-out views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from epipole._checks import as_path
from epipole._jit import compile_seconds
from epipole.config import options_of
from epipole.errors import FileFormatError, WorkspaceError
from epipole.fields.trainer import Trainer
from epipole.io.files import missing_in_words
from epipole.io.models.losses import losses_in, losses_of
from epipole.pipelines.fields.checkpoints import Checkpoint
from epipole.pipelines.fields.config import FieldOptions, NerfConfig, SplatConfig
from epipole.pipelines.fields.held_out import probed
from epipole.pipelines.fields.images import FieldImages, gather_field_images
from epipole.pipelines.fields.page import FieldPage, render_page
from epipole.pipelines.fields.scene import FIRST_VIEW, SPLAT, scene_of_training
from epipole.pipelines.fields.surface_points import scene_of_surface
from epipole.pipelines.fields.surfaces import seen_from
from epipole.pipelines.fields.watching import open_watch
from epipole.pipelines.sfm.run import reconstruct
from epipole.report.space_scene import SpaceScene
from epipole.runs import Job, PassedExecutor, ProgressCallback, Run, chosen_executor, graceful_interrupt
from epipole.runs.earlier import note_on_poorer
from epipole.runs.model_source import is_model

METRICS, MODEL, REPORT = "metrics.json", "sfm", "report.html"
C = TypeVar("C", SplatConfig, NerfConfig)
MEANS = ("psnr", "ssim", "psnr_matched")
CURVE_POINTS = 200
WATCHING = ("view", "host", "port", "cluster", "shared_folder")
"""Options of the live view and of the cluster, which do not affect the result."""
PROBES = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.85)
"""Fractions of the training at which some held-out views are rendered and compared; their time is not counted."""
PROBE_FRACTION = 0.1
"""Fraction of the training time that these comparisons may take; slower ones are skipped, as fog is slow to render."""


@dataclass(frozen=True, slots=True)
class Training(Generic[C]):
    """A training job with its options."""

    source: Path
    out: Path
    config: C
    settings: dict[str, Any]
    """Settings for `config.json`, without the options of the live view."""
    task: Job


def training_of(
    kind: str,
    paths: tuple[str | Path, str | Path],
    config: tuple[type[C], C | None],
    progress: ProgressCallback,
    options: Mapping[str, Any],
    executor: PassedExecutor | None = None,
) -> Training[C]:
    """Put together the arguments of a job.

    Args:
        kind: kind of job.
        paths: source and output folder.
        config: class of the options, and the options given.
        progress: called with the progress of each stage.
        options: single options by name.
        executor: executor for images, instead of the config's cluster.

    Raises:
        ConfigError: an option is unknown or invalid.
        FileFormatError: the source does not exist.
    """
    found = options_of(*config, options, ["config", "progress", "executor"])
    source, out = (as_path(path) for path in paths)
    if not source.exists():
        raise FileFormatError(source, missing_in_words(source))
    settings = {name: value for name, value in asdict(found).items() if name not in WATCHING}
    job = Job(
        kind=kind,
        inputs=(source,),
        settings=settings,
        progress=progress,
        executor=chosen_executor(executor, found.cluster, has_shared_folder=found.shared_folder),
        has_log=True,
    )
    return Training(source, out, found, settings, job)


class Trained(NamedTuple):
    """Outcome of a training."""

    curve: list[list[float]]
    """Seconds, step, loss and size during training."""
    probes: list[list[float]]
    """Seconds, step and mean PSNR of some held-out views."""
    is_interrupted: bool


def images_of(source: Path, run: Run, wanted: FieldOptions) -> FieldImages:
    """Cameras and images of a source; photographs are reconstructed first, into a subfolder.

    Anything lost on the way is reported in `problems`.
    """
    model, photographs = source, None
    if is_model(source):
        losses = losses_in(source)
    else:
        model = run.root / MODEL
        found = reconstruct(
            source, model, progress=run.job.progress, executor=run.job.executor, masks=wanted.masks
        )
        losses = losses_of(found.summary, model)
        photographs = source if source.is_dir() else model / "images"
    images = gather_field_images(model, wanted, photographs, run.job.progress)
    return replace(images, problems=[*losses, *images.problems])


def background_of(wanted: FieldOptions, images: FieldImages) -> np.ndarray:
    """(3,) background color, white or black."""
    is_white = wanted.background == "white" or (wanted.background == "auto" and images.has_alpha)
    return np.full(3, 1.0 if is_white else 0.0, np.float32)


def train(
    trainer: Trainer,
    images: FieldImages,
    wanted: FieldOptions,
    run: Run,
    note: str = "",
    checkpoint: Checkpoint | None = None,
) -> Trained:
    """Train until the time or the steps are used up.

    The first Ctrl-C ends the training after the current step, so that its state stays consistent; the second
    interrupts.
    """
    limit, curve, earlier, probes = wanted.seconds, list[list[float]](), 0.0, list[list[float]]()
    if checkpoint is not None:
        earlier, curve = checkpoint.restore()
    if trainer.num_steps:
        run.warnings.append(f"continued an earlier run at step {trainer.num_steps}")
    start, compiling, aside = perf_counter(), compile_seconds(), 0.0

    def seconds() -> float:
        return earlier + perf_counter() - start - aside - (compile_seconds() - compiling)

    def done() -> float:
        if limit is None:
            return trainer.num_steps / (wanted.steps or 1)
        return seconds() / limit

    is_over = False
    run.report("train", 0, 100, note)
    num_due = sum(fraction < done() for fraction in PROBES)
    with open_watch(wanted, images, trainer, run.root.name) as watch, graceful_interrupt() as is_pressed:
        while (fraction := done()) < 1.0 and not is_over:
            if num_due < len(PROBES) and fraction >= PROBES[num_due]:
                num_due += 1
                at, paused, compiled = seconds(), perf_counter(), compile_seconds()
                similarity_then = probed(trainer, images.test, PROBE_FRACTION * at - aside)
                aside += perf_counter() - paused - (compile_seconds() - compiled)
                if similarity_then is not None:
                    probes.append([at, trainer.num_steps, similarity_then])
            loss = trainer.step(fraction)
            watch.show(trainer, fraction)
            is_over = is_pressed()
            if fraction * CURVE_POINTS >= len(curve):
                curve.append([seconds(), trainer.num_steps, loss, len(trainer)])
                try:
                    run.report("train", min(round(100 * fraction), 99), 100)
                except KeyboardInterrupt:  # from the caller's own callback
                    is_over = True
            if checkpoint is not None and (is_over or checkpoint.is_due()):
                _keep(checkpoint, seconds(), curve, run)
    if not is_over:
        run.report("train", 100, 100)
    return Trained(curve, probes, is_over)


def _keep(checkpoint: Checkpoint, seconds: float, curve: list[list[float]], run: Run) -> None:
    """Write a checkpoint; if that fails, the training continues with a warning."""
    try:
        checkpoint.save(seconds, curve)
    except WorkspaceError as error:
        note = f"no checkpoint was saved, so this training cannot be continued later: {error}"
        run.warnings += [] if note in run.warnings else [note]


def _scene(
    root: Path, images: FieldImages, first_view: dict[str, list[float]], background: float
) -> SpaceScene | None:
    """What the report shows in 3D: Gaussians, or points on the surfaces of a radiance field."""
    if (root / SPLAT).is_file():
        return scene_of_training(root, first_view, background)
    return scene_of_surface(seen_from(root)[0], images.train, first_view, root.resolve().name)


def finished(
    trainer: Trainer,
    images: FieldImages,
    scores: list[dict[str, Any]],
    trained: Trained,
    run: Run,
    **more: Any,
) -> dict[str, Any]:
    """Write `metrics.json` and `report.html` and end the run; returns the summary."""
    run.warnings += note_on_poorer(run.root, "steps", trainer.num_steps, "steps of training")
    summary: dict[str, Any] = {
        **more,
        "interrupted": trained.is_interrupted,
        "num_train": len(images.train),
        "num_test": len(images.test),
        "num_compared": len(scores),
        "steps": trainer.num_steps,
        "train_s": trained.curve[-1][0] if trained.curve else 0.0,
        **{name: float(np.mean([one[name] for one in scores])) if scores else None for name in MEANS},
        "background": "white" if trainer.background[0] else "black",
        "warnings": run.warnings,
        "timings_s": run.timings_s,
    }
    tables: dict[str, dict[str, list[Any]]] = {
        "curve": {"columns": ["s", "step", "loss", "size"], "rows": trained.curve},
        "held_out": {"columns": ["s", "step", "psnr"], "rows": trained.probes if images.test else []},
    }
    run.folder.write_json(METRICS, {**summary, "views": scores, **tables})
    shown = _scene(run.root, images, summary[FIRST_VIEW], float(trainer.background[0]))
    page = render_page(
        FieldPage(summary, scores, images, trainer.background, tables, run.root, shown, run.warnings)
    )
    run.folder.write_text(REPORT, page)
    run.finish(summary)
    return summary
