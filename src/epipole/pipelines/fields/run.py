"""The job: pictures to Gaussians, with pictures of held-out views and figures, in one folder."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from epipole._checks import as_path
from epipole._jit import compile_seconds
from epipole.config import options_of
from epipole.errors import FileFormatError
from epipole.fields import render
from epipole.fields.config import SplatConfig
from epipole.fields.photometric import likeness, psnr
from epipole.fields.splat_trainer import SplatTrainer
from epipole.fields.starting import cloud_of_points, points_in_silhouettes
from epipole.fields.training_view import TrainingView
from epipole.io.gaussian_ply import write_gaussian_ply
from epipole.io.rgba_pictures import write_png
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.pictures import FieldPictures, gather_field_pictures, is_model
from epipole.pipelines.fields.scene import FIRST_VIEW, SPLAT, first_view_of
from epipole.pipelines.sfm.run import reconstruct
from epipole.runs import Job, ProgressCallback, Run, ignore_progress, open_run
from epipole.scene.gaussian_cloud import GaussianCloud

METRICS, MODEL = "metrics.json", "sfm"
LEAST_POINTS = 100
"""Of a model: with fewer the first Gaussians are drawn."""
FIRST_SHARE = 0.1
"""Of the Gaussians in the end, where they are drawn."""
CURVE_POINTS = 200
BORNE, STEP_S = 3600.0, 0.02
"""Gaussians that a second bears, which grow with the root of the time; and about how long a step takes."""
PIXELS_OF_EACH = 80
"""Pixels for each Gaussian, which has 59 numbers: with fewer, what few pictures show is learnt by heart."""


@dataclass(frozen=True, slots=True, eq=False)
class SplatResult:
    """Trained Gaussians, and how like the pictures they are."""

    out: Path
    cloud: GaussianCloud
    summary: dict[str, Any]
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        return f"SplatResult({self.cloud!r} in {self.out})"


def splat(
    source: str | Path,
    out: str | Path,
    config: SplatConfig | None = None,
    job: FieldOptions | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Any,
) -> SplatResult:
    """Train 3D Gaussians on pictures; Ctrl-C ends the training, and keeps what was learnt.

    Args:
        source: a folder of photographs or a video, whose cameras are found first (`OUT/sfm`); an output folder of
            `reconstruct`; a COLMAP model; or a transforms.json.
        out: output folder: `splat.ply`, `test/NAME.png`, `metrics.json`.
        config: options of the training; None for the defaults.
        job: which pictures, and for how long.
        progress: called with the progress of each stage.
        **options: single options of both by name, which override them: `time="1m"`.

    Raises:
        NoModelError: the pictures give no cameras, or fewer than two can be used.
        ConfigError: an option is unknown or makes no sense.
        DegenerateGeometryError: the cameras see nothing in common.
        FileFormatError: the source cannot be read.
        WorkspaceError: the output folder cannot be used.
    """
    own = {field.name: options.pop(field.name) for field in fields(FieldOptions) if field.name in options}
    wanted, config = options_of(FieldOptions, job, own), options_of(SplatConfig, config, options)
    source, out = as_path(source), as_path(out)
    if not source.exists():
        raise FileFormatError(source, "there is no such file or folder")
    settings = {"job": asdict(wanted), "config": asdict(config)}
    task = Job(kind="splat", inputs=(source,), settings=settings, progress=progress)
    with open_run(task, out) as run:
        with run.stage("read"):
            pictures = _pictures(source, run, wanted)
        run.warnings += pictures.problems
        if config.max_gaussians is None:
            config = replace(config, max_gaussians=_borne(pictures, wanted))
        background = _background(wanted, pictures)
        with run.stage("start"):
            trainer = SplatTrainer(pictures.train, _start(pictures, config), config, background)
        with run.stage("train"):
            curve, is_interrupted = _train(trainer, wanted, run)
        return _written(trainer, pictures, curve, run, is_interrupted=is_interrupted)


def _pictures(source: Path, run: Run, wanted: FieldOptions) -> FieldPictures:
    if is_model(source):
        return gather_field_pictures(source, wanted)
    model = run.root / MODEL
    reconstruct(source, model, progress=run.job.progress)
    pictures = source if source.is_dir() else model / "images"
    return gather_field_pictures(model, wanted, pictures)


def _borne(pictures: FieldPictures, wanted: FieldOptions) -> int:
    """As many Gaussians as the time bears, and as the pictures tell apart."""
    seconds = STEP_S * (wanted.steps or 0) if wanted.seconds is None else wanted.seconds
    told = sum(view.camera.width * view.camera.height for view in pictures.train) / PIXELS_OF_EACH
    return max(LEAST_POINTS, int(min(BORNE * seconds**0.5, told)))


def _background(wanted: FieldOptions, pictures: FieldPictures) -> np.ndarray:
    is_white = wanted.background == "white" or (wanted.background == "auto" and pictures.has_alpha)
    return np.full(3, 1.0 if is_white else 0.0, np.float32)


def _start(pictures: FieldPictures, config: SplatConfig) -> GaussianCloud:
    points, rgb = pictures.points_in_world, pictures.rgb
    good = np.isfinite(points).all(axis=1)
    if good.sum() < LEAST_POINTS:
        count = max(LEAST_POINTS, int(FIRST_SHARE * (config.max_gaussians or 0)))
        points, rgb = points_in_silhouettes(pictures.train, count, config.seed)
        good = np.ones(len(points), bool)
    return cloud_of_points(points[good], rgb[good])


def _train(trainer: SplatTrainer, wanted: FieldOptions, run: Run) -> tuple[list[list[float]], bool]:
    """Steps until the time is over; seconds, step and loss along the way, and whether Ctrl-C ended it."""
    limit, curve = wanted.seconds, list[list[float]]()
    begin, compiling = perf_counter(), compile_seconds()

    def seconds() -> float:
        return perf_counter() - begin - (compile_seconds() - compiling)

    def done() -> float:
        if limit is None:
            return trainer.num_steps / (wanted.steps or 1)
        return seconds() / limit

    try:
        while (share := done()) < 1.0:
            loss = trainer.step(share)
            if share * CURVE_POINTS >= len(curve):
                curve.append([seconds(), trainer.num_steps, loss, len(trainer)])
                run.report("train", min(round(100 * share), 99), 100)
    except KeyboardInterrupt:
        if not trainer.num_steps:
            raise
        return curve, True
    run.report("train", 100, 100)
    return curve, False


def _written(
    trainer: SplatTrainer,
    pictures: FieldPictures,
    curve: list[list[float]],
    run: Run,
    *,
    is_interrupted: bool,
) -> SplatResult:
    cloud = trainer.cloud
    with run.stage("write"), run.folder.publish("model") as aside:
        write_gaussian_ply(aside / SPLAT, cloud)
    with run.stage("test"), run.folder.publish("test") as aside:
        scores = []
        for n, view in enumerate(pictures.test):
            scores.append(_scored(trainer, cloud, view, aside))
            run.report("test", n + 1, len(pictures.test))
    summary: dict[str, Any] = {
        "num_gaussians": len(cloud),
        "num_train": len(pictures.train),
        "num_test": len(pictures.test),
        "steps": trainer.num_steps,
        "train_s": curve[-1][0] if curve else 0.0,
        "psnr": float(np.mean([one["psnr"] for one in scores])) if scores else None,
        "ssim": float(np.mean([one["ssim"] for one in scores])) if scores else None,
        "background": "white" if trainer.background[0] else "black",
        "interrupted": is_interrupted,
        FIRST_VIEW: first_view_of(cloud, pictures.train),
        "timings_s": run.timings_s,
    }
    content = {
        **summary,
        "views": scores,
        "curve": {"columns": ["s", "step", "loss", "gaussians"], "rows": curve},
    }
    run.folder.write_json(METRICS, content)
    run.finish(summary)
    return SplatResult(run.root, cloud, summary, tuple(run.warnings))


def _scored(trainer: SplatTrainer, cloud: GaussianCloud, view: TrainingView, folder: Path) -> dict[str, Any]:
    """Draw a held-out view, write it, and compare."""
    drawn = render(cloud, view.camera, view.cam_from_world, trainer.options).over(trainer.background)
    truth = view.over(trainer.background)
    name = f"{Path(view.name).with_suffix('')}.png".replace("/", "_")
    write_png(folder / "test" / name, np.rint(255 * np.clip(drawn, 0, 1)).astype(np.uint8))
    return {"name": view.name, "psnr": psnr(drawn, truth), "ssim": likeness(drawn, truth).ssim}
