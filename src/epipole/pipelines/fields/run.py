"""The job: pictures to Gaussians, with pictures of held-out views and figures, in one folder."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks import as_path
from epipole.config import options_of
from epipole.errors import FileFormatError
from epipole.fields.config import SplatConfig
from epipole.fields.splat_trainer import SplatTrainer
from epipole.fields.starting import cloud_of_points, points_in_silhouettes
from epipole.io.gaussian_ply import write_gaussian_ply
from epipole.pipelines.fields.checkpoints import Checkpoint
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.pictures import FieldPictures
from epipole.pipelines.fields.scene import FIRST_VIEW, SPLAT, first_view_of
from epipole.pipelines.fields.training import background_of, compared, finished, pictures_of, train
from epipole.runs import Job, ProgressCallback, ignore_progress, open_run
from epipole.scene.gaussian_cloud import GaussianCloud

LEAST_POINTS = 100
"""Of a model: with fewer the first Gaussians are drawn."""
FIRST_SHARE = 0.1
"""Of the Gaussians in the end, where they are drawn."""
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

    Called again with the same options it goes on where it was; after a crash, where it was at most a minute before.

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
            pictures = pictures_of(source, run, wanted)
        run.warnings += pictures.problems
        if config.max_gaussians is None:
            config = replace(config, max_gaussians=_borne(pictures, wanted))
        background = background_of(wanted, pictures)
        with run.stage("start"):
            trainer = SplatTrainer(pictures.train, _start(pictures, config), config, background)
        with run.stage("train"):
            checkpoint = Checkpoint(run.root, settings, pictures.train, trainer)
            curve, is_interrupted = train(trainer, wanted, run, checkpoint)
        cloud = trainer.cloud
        with run.stage("write"), run.folder.publish("model") as aside:
            write_gaussian_ply(aside / SPLAT, cloud)
        told: dict[str, Any] = {"num_gaussians": len(cloud), "interrupted": is_interrupted}
        told[FIRST_VIEW] = first_view_of(cloud.means_in_world, pictures.train)
        summary = finished(trainer, pictures, compared(trainer, pictures, run), curve, run, **told)
        if not is_interrupted:
            checkpoint.remove()
        return SplatResult(run.root, cloud, summary, tuple(run.warnings))


def _borne(pictures: FieldPictures, wanted: FieldOptions) -> int:
    """As many Gaussians as the time bears, and as the pictures tell apart."""
    seconds = STEP_S * (wanted.steps or 0) if wanted.seconds is None else wanted.seconds
    told = sum(view.camera.width * view.camera.height for view in pictures.train) / PIXELS_OF_EACH
    return max(LEAST_POINTS, int(min(BORNE * seconds**0.5, told)))


def _start(pictures: FieldPictures, config: SplatConfig) -> GaussianCloud:
    points, rgb = pictures.points_in_world, pictures.rgb
    good = np.isfinite(points).all(axis=1)
    if good.sum() < LEAST_POINTS:
        count = max(LEAST_POINTS, int(FIRST_SHARE * (config.max_gaussians or 0)))
        points, rgb = points_in_silhouettes(pictures.train, count, config.seed)
        good = np.ones(len(points), bool)
    return cloud_of_points(points[good], rgb[good])
