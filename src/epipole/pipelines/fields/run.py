"""The jobs `splat` and `nerf`: from images to a trained field, with renders of held-out views and figures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

from epipole.errors import ConfigError
from epipole.pipelines.fields.checkpoints import Checkpoint
from epipole.pipelines.fields.config import NerfConfig, SplatConfig
from epipole.pipelines.fields.held_out import Renderer, WrittenField, compared
from epipole.pipelines.fields.images import FieldImages
from epipole.pipelines.fields.options import NerfKeywords, SplatKeywords
from epipole.pipelines.fields.recipes import GaussianRecipe, RayRecipe
from epipole.pipelines.fields.training import Training, background_of, finished, images_of, train, training_of
from epipole.runs import PassedExecutor, ProgressCallback, ignore_progress, open_run
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.scene.notebook import table_html


@dataclass(frozen=True, slots=True, eq=False)
class FieldResult:
    """A trained field and how well it renders held-out views."""

    out: Path
    field: Any
    """A GaussianCloud of `splat`; Voxels or a HashField of `nerf`."""
    summary: dict[str, Any]
    warnings: tuple[str, ...]

    @property
    def cloud(self) -> GaussianCloud:
        """The Gaussians of `splat`.

        Raises:
            ConfigError: the field is one of `nerf`.
        """
        if not isinstance(self.field, GaussianCloud):
            raise ConfigError(f"a {type(self.field).__name__} has no Gaussians: train them with splat")
        return self.field

    def __repr__(self) -> str:
        return f"FieldResult({self.summary.get('kind', self.field)!s} in {self.out})"

    def _repr_html_(self) -> str:
        rows = {name: self.summary.get(name) for name in ("psnr", "ssim", "steps", "train_s")}
        return table_html("FieldResult", rows | {"warnings": len(self.warnings), "folder": self.out})


def splat(
    source: str | Path,
    out: str | Path,
    config: SplatConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    executor: PassedExecutor | None = None,
    **options: Unpack[SplatKeywords],
) -> FieldResult:
    """Train 3D Gaussians on images. Ctrl-C ends the training and keeps the result.

    Called again with the same options, an interrupted training continues; a crash loses at most a minute.

    Args:
        source: a folder of photographs or a video, which is reconstructed first (`OUT/sfm`); an output folder of
            `reconstruct`; a COLMAP model; or a transforms.json.
        out: output folder: `splat.ply`, `test/NAME.png`, `metrics.json`, `report.html`.
        config: options; None for the defaults.
        progress: called with the progress of each stage.
        executor: executor for images instead of the config's cluster, as for `reconstruct`.
        **options: single options by name, which override `config`: `time="1m"`.

    Raises:
        NoModelError: the images cannot be reconstructed, or fewer than two can be used.
        ConfigError: an option is unknown or invalid.
        DegenerateGeometryError: the cameras see nothing in common.
        FileFormatError: the source cannot be read.
        WorkspaceError: the output folder cannot be used.
    """
    given = training_of("splat", (source, out), (SplatConfig, config), progress, options, executor)
    return train_field(given, GaussianRecipe(given.config))[0]


def nerf(
    source: str | Path,
    out: str | Path,
    config: NerfConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    executor: PassedExecutor | None = None,
    **options: Unpack[NerfKeywords],
) -> FieldResult:
    """Train a neural field or an explicit grid on images around a scene. Ctrl-C ends the training and keeps the result.

    Called again with the same options, an interrupted training continues; a crash loses at most a minute.

    Args:
        source: as for `splat`, or a folder with LLFF's poses_bounds.npy.
        out: output folder: `hash.npz` or `grid.npz`, `test/NAME.png`, `metrics.json`, `report.html`.
        config: options; None for the defaults.
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
    given = training_of("nerf", (source, out), (NerfConfig, config), progress, options, executor)
    return train_field(given, RayRecipe(given.config))[0]


def train_field(
    given: Training[Any], recipe: GaussianRecipe | RayRecipe, images: FieldImages | None = None
) -> tuple[FieldResult, FieldImages]:
    """Run a training on the given images, or on those of its source; returns the images, too."""
    with open_run(given.task, given.out) as run:
        with run.stage("read"):
            if images is None:
                images = recipe.prepared(images_of(given.source, run, given.config))
        run.warnings += images.problems
        with run.stage("start"):
            trainer, note = recipe.start(images, background_of(given.config, images), run)
        with run.stage("train"):
            checkpoint = Checkpoint(run.root, given.settings, images.train, trainer)
            trained = train(trainer, images, given.config, run, note, checkpoint)
        with run.stage("write"), run.folder.publish("model") as aside:
            field = recipe.write(aside, trainer, images)
        renderer: Renderer = trainer
        if isinstance(recipe, RayRecipe):  # its tables are rounded in the file
            renderer = WrittenField(run.root / recipe.file, float(trainer.background[0]))
        scores = compared(renderer, images.test, given.config, run)
        facts = recipe.facts(trainer, field, images)
        summary = finished(trainer, images, scores, trained, run, **facts)
        if not trained.is_interrupted:
            checkpoint.remove()
        return FieldResult(run.root, field, summary, tuple(run.warnings)), images
