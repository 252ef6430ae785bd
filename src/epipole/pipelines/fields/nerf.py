"""The job: images to a field that is marched through, with images of held-out views and figures, in one folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epipole.fields.config import NerfConfig
from epipole.pipelines.fields.checkpoints import Checkpoint
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.held_out import compared
from epipole.pipelines.fields.images import FieldImages
from epipole.pipelines.fields.kinds import KINDS, Field
from epipole.pipelines.fields.scene import CAMERAS, FIRST_VIEW, first_view_of, write_cameras
from epipole.pipelines.fields.training import Called, background_of, called, finished, images_of, train
from epipole.runs import ProgressCallback, ignore_progress, open_run


@dataclass(frozen=True, slots=True, eq=False)
class NerfResult:
    """A trained field, and how like the images it is."""

    out: Path
    field: Field
    summary: dict[str, Any]
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        return f"NerfResult({self.summary['kind']} in {self.out})"


def nerf(
    source: str | Path,
    out: str | Path,
    config: NerfConfig | None = None,
    job: FieldOptions | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Any,
) -> NerfResult:
    """Train a neural field, or a grid of densities and colours, on images that surround a scene; Ctrl-C ends the training, and keeps what was learnt.

    Called again with the same options it goes on where it was; after a crash, where it was at most a minute before.

    Args:
        source: as of `splat`: photographs, a video, an output folder of `reconstruct`, a COLMAP model, a transforms.json or
            LLFF's poses_bounds.npy.
        out: output folder: `hash.npz` or `grid.npz`, `test/NAME.png`, `metrics.json`, `report.html`.
        config: options of the training; None for the defaults.
        job: which images, and for how long.
        progress: called with the progress of each stage.
        **options: single options of both by name, which override them: `time="1m"`.

    Raises:
        NoModelError: the images give no cameras, or fewer than two can be used.
        ConfigError: an option is unknown or makes no sense.
        DegenerateGeometryError: the cameras see nothing in common, or look the same way.
        FileFormatError: the source cannot be read.
        WorkspaceError: the output folder cannot be used.
    """
    return nerf_of(called("nerf", (source, out), (NerfConfig, config), job, progress, options))[0]


def nerf_of(given: Called[NerfConfig], images: FieldImages | None = None) -> tuple[NerfResult, FieldImages]:
    """The job as it was called, on images that were read before, or on those of its source; and the images."""
    source, wanted, config = given.source, given.images, given.config
    kind = KINDS[config.kind]
    with open_run(given.task, given.out) as run:
        with run.stage("read"):
            images = images_of(source, run, wanted) if images is None else images
        run.warnings += images.problems
        with run.stage("start"):
            run.report("start", 0, 1)
            trainer = kind.trainer(images.train, background_of(wanted, images), config.seed)
            run.report("start", 1, 1)
        with run.stage("train"):
            checkpoint = Checkpoint(run.root, given.settings, images.train, trainer)
            trained = train(trainer, images, wanted, run, checkpoint=checkpoint)
        with run.stage("write"), run.folder.publish("model") as aside:
            kind.write(aside / kind.file, trainer.field)
            write_cameras(aside / CAMERAS, images.train)
        figures: dict[str, Any] = {
            kind.count: len(trainer),
            "kind": config.kind,
        }
        figures[FIRST_VIEW] = first_view_of(kind.positions(trainer.field), images.train)
        summary = finished(
            trainer, images, compared(trainer, images.test, wanted, run), trained, run, **figures
        )
        if not trained.is_interrupted:
            checkpoint.remove()
        return NerfResult(run.root, trainer.field, summary, tuple(run.warnings)), images
