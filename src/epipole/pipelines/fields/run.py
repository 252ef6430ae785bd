"""The job: images to Gaussians, with images of held-out views and figures, in one folder."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from epipole.errors import ConfigError
from epipole.fields.config import SplatConfig
from epipole.fields.splat.trainer import SplatTrainer
from epipole.io.gaussians.ply import write_gaussian_ply
from epipole.pipelines.fields.checkpoints import Checkpoint
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.first_gaussians import LEAST_POINTS, first_gaussians
from epipole.pipelines.fields.held_out import compared
from epipole.pipelines.fields.images import FieldImages
from epipole.pipelines.fields.scene import (
    ANTIALIASED,
    CAMERAS,
    FIRST_VIEW,
    SPLAT,
    first_view_of,
    write_cameras,
)
from epipole.pipelines.fields.training import Called, background_of, called, finished, images_of, train
from epipole.runs import ProgressCallback, ignore_progress, open_run
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.scene.local_origin import ORIGIN

BORNE, STEP_S = 3600.0, 0.02
"""Gaussians that a second bears, which grow with the root of the time; and about how long a step takes."""
PROGRAM_BYTES, WORK_BYTES, WORK_BYTES_OF_PIXEL = 230e6, 480, 200
"""Memory of the program alone, and what a step, or writing the file, needs of each Gaussian, and a step of each pixel: measured."""
PIXELS_OF_EACH = 80
"""Pixels for each Gaussian, which has 59 numbers: with fewer, what few images show is learnt by heart."""


@dataclass(frozen=True, slots=True, eq=False)
class SplatResult:
    """Trained Gaussians, and how like the images they are."""

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
    """Train 3D Gaussians on images; Ctrl-C ends the training, and keeps what was learnt.

    Called again with the same options it goes on where it was; after a crash, where it was at most a minute before.

    Args:
        source: a folder of photographs or a video, whose cameras are found first (`OUT/sfm`); an output folder of
            `reconstruct`; a COLMAP model; or a transforms.json.
        out: output folder: `splat.ply`, `test/NAME.png`, `metrics.json`, `report.html`.
        config: options of the training; None for the defaults.
        job: which images, and for how long.
        progress: called with the progress of each stage.
        **options: single options of both by name, which override them: `time="1m"`.

    Raises:
        NoModelError: the images give no cameras, or fewer than two can be used.
        ConfigError: an option is unknown or makes no sense.
        DegenerateGeometryError: the cameras see nothing in common.
        FileFormatError: the source cannot be read.
        WorkspaceError: the output folder cannot be used.
    """
    return splat_of(called("splat", (source, out), (SplatConfig, config), job, progress, options))[0]


def splat_of(given: Called[SplatConfig]) -> tuple[SplatResult, FieldImages]:
    """The job as it was called, and the images that it read."""
    source, wanted, config = given.source, given.images, given.config
    with open_run(given.task, given.out) as run:
        with run.stage("read"):
            images = images_of(source, run, wanted).about_origin()
        run.warnings += images.problems
        most = _fitting(config, images, wanted)
        config = replace(config, max_gaussians=most)
        background = background_of(wanted, images)
        with run.stage("start"):
            start = first_gaussians(images, config, most, partial(run.report, "start"))
            run.warnings += start.warnings
            trainer = SplatTrainer(images.train, start.cloud, config, background)
        with run.stage("train"):
            checkpoint = Checkpoint(run.root, given.settings, images.train, trainer)
            gigabytes = 1e-9 * _memory(images, most, config.sh_degree)
            note = f"up to {most:,} Gaussians on {len(images.train)} images, about {gigabytes:.1f} GB"
            trained = train(trainer, images, wanted, run, note, checkpoint)
        cloud = replace(trainer.cloud, origin_in_world=images.origin_in_world)
        with run.stage("write"), run.folder.publish("model") as aside:
            write_gaussian_ply(aside / SPLAT, cloud)
            write_cameras(aside / CAMERAS, trainer.posed_views, images.origin_in_world)
        figures: dict[str, Any] = {"num_gaussians": len(cloud), ANTIALIASED: config.antialiased}
        figures[FIRST_VIEW] = first_view_of(cloud.means_in_world, images.train, images.origin_in_world)
        if images.origin_in_world.any():
            figures[ORIGIN] = images.origin_in_world.tolist()
        summary = finished(
            trainer, images, compared(trainer, images.test, wanted, run), trained, run, **figures
        )
        if not trained.is_interrupted:
            checkpoint.remove()
        return SplatResult(run.root, cloud, summary, tuple(run.warnings)), images


def _memory(images: FieldImages, count: int, sh_degree: int) -> float:
    """Bytes that a training of so many Gaussians takes, with the images in three sizes and what their comparison needs."""
    views = [*images.train, *images.test]
    num_bytes = sum(view.image.nbytes for view in views) * 21 / 16
    largest = max(view.camera.width * view.camera.height for view in views)
    numbers = 3 * (11 + 3 * (1 + sh_degree) ** 2)
    return PROGRAM_BYTES + num_bytes + WORK_BYTES_OF_PIXEL * largest + (4 * numbers + WORK_BYTES) * count


def _fitting(config: SplatConfig, images: FieldImages, wanted: FieldOptions) -> int:
    """How many Gaussians there may be.

    Raises:
        ConfigError: the memory is too small for the images, or for as many as are asked for.
    """
    requested = config.max_gaussians
    most = _borne(images, wanted) if requested is None else requested
    if config.memory_gb is None:
        return most
    none = _memory(images, 0, config.sh_degree)
    each = _memory(images, 1, config.sh_degree) - none
    fits = int((1e9 * config.memory_gb - none) / each)
    if fits < (LEAST_POINTS if requested is None else requested):
        needs = _memory(images, LEAST_POINTS if requested is None else requested, config.sh_degree)
        raise ConfigError(
            f"memory_gb is {config.memory_gb:g}, and {needs / 1e9:.2f} are needed for these images and"
            f" {LEAST_POINTS if requested is None else requested:,} Gaussians: smaller images (max_side_px) or"
            " fewer Gaussians take less"
        )
    return min(most, fits)


def _borne(images: FieldImages, wanted: FieldOptions) -> int:
    """As many Gaussians as the time bears, and as the images tell apart."""
    seconds = STEP_S * (wanted.steps or 0) if wanted.seconds is None else wanted.seconds
    figures = sum(view.camera.width * view.camera.height for view in images.train) / PIXELS_OF_EACH
    return max(LEAST_POINTS, int(min(BORNE * seconds**0.5, figures)))
