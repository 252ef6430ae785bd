"""The job: pictures to a field that is marched through, with pictures of held-out views and figures, in one folder."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks import as_path
from epipole.config import options_of
from epipole.errors import FileFormatError
from epipole.fields.config import NerfConfig
from epipole.fields.voxel_field import Voxels, unit_of
from epipole.fields.voxel_trainer import VoxelTrainer
from epipole.io.voxel_files import WIDTH, GridContents, write_grid
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.scene import FIRST_VIEW, GRID, first_view_of
from epipole.pipelines.fields.training import background_of, compared, finished, pictures_of, train
from epipole.runs import Job, ProgressCallback, ignore_progress, open_run


@dataclass(frozen=True, slots=True, eq=False)
class NerfResult:
    """A trained field, and how like the pictures it is."""

    out: Path
    voxels: Voxels
    summary: dict[str, Any]
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        return f"NerfResult({len(self.voxels.values):,} corners of voxels in {self.out})"


def nerf(
    source: str | Path,
    out: str | Path,
    config: NerfConfig | None = None,
    job: FieldOptions | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Any,
) -> NerfResult:
    """Train a field of densities and colours on pictures that surround a scene; Ctrl-C ends the training, and keeps what was learnt.

    Args:
        source: as of `splat`: photographs, a video, an output folder of `reconstruct`, a COLMAP model, a transforms.json or
            LLFF's poses_bounds.npy.
        out: output folder: `grid.npz`, `test/NAME.png`, `metrics.json`.
        config: options of the training; None for the defaults.
        job: which pictures, and for how long.
        progress: called with the progress of each stage.
        **options: single options of both by name, which override them: `time="1m"`.

    Raises:
        NoModelError: the pictures give no cameras, or fewer than two can be used.
        ConfigError: an option is unknown or makes no sense.
        DegenerateGeometryError: the cameras see nothing in common, or look the same way.
        FileFormatError: the source cannot be read.
        WorkspaceError: the output folder cannot be used.
    """
    own = {field.name: options.pop(field.name) for field in fields(FieldOptions) if field.name in options}
    wanted, config = options_of(FieldOptions, job, own), options_of(NerfConfig, config, options)
    source, out = as_path(source), as_path(out)
    if not source.exists():
        raise FileFormatError(source, "there is no such file or folder")
    settings = {"job": asdict(wanted), "config": asdict(config)}
    task = Job(kind="nerf", inputs=(source,), settings=settings, progress=progress)
    with open_run(task, out) as run:
        with run.stage("read"):
            pictures = pictures_of(source, run, wanted)
        run.warnings += pictures.problems
        with run.stage("start"):
            trainer = VoxelTrainer(pictures.train, background_of(wanted, pictures), config.seed)
        with run.stage("train"):
            curve, is_interrupted = train(trainer, wanted, run)
        with run.stage("write"), run.folder.publish("model") as aside:
            write_grid(aside / GRID, _contents(trainer.voxels))
        told: dict[str, Any] = {
            "num_voxels": len(trainer),
            "kind": config.kind,
            "interrupted": is_interrupted,
        }
        told[FIRST_VIEW] = first_view_of(_places(trainer.voxels), pictures.train)
        summary = finished(trainer, pictures, compared(trainer, pictures, run), curve, run, **told)
        return NerfResult(run.root, trainer.voxels, summary, tuple(run.warnings))


def _contents(voxels: Voxels) -> GridContents:
    cells = voxels.occupied.astype(bool)
    return GridContents(cells, voxels.values[:, :WIDTH], voxels.low, voxels.size, unit_of(voxels))


def _places(voxels: Voxels) -> np.ndarray:
    """(n, 3) middles of cells in which something was seen, of all where nothing was."""
    cells = voxels.seen if voxels.seen.any() else voxels.occupied
    return voxels.low + voxels.size * (np.argwhere(cells) + 0.5)
