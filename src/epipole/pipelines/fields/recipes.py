"""Differences between training Gaussians and training a grid or a hash field: start, files, summary."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from epipole.errors import ConfigError
from epipole.fields.splat.trainer import SplatTrainer
from epipole.fields.trainer import Trainer
from epipole.io.gaussians.ply import write_gaussian_ply
from epipole.pipelines.fields.config import NerfConfig, SplatConfig
from epipole.pipelines.fields.first_gaussians import LEAST_POINTS, first_gaussians
from epipole.pipelines.fields.images import FieldImages
from epipole.pipelines.fields.kinds import KINDS
from epipole.pipelines.fields.scene import (
    ANTIALIASED,
    CAMERAS,
    FIRST_VIEW,
    SPLAT,
    first_view_of,
    write_cameras,
)
from epipole.runs import Run
from epipole.scene.local_origin import ORIGIN

BORNE = 3600.0
"""Gaussians for a training of one second; the number grows with the square root of the time."""
STEP_S = 0.02
"""Typical time of a step."""
PROGRAM_BYTES, WORK_BYTES, WORK_BYTES_OF_PIXEL = 230e6, 480, 200
"""Measured memory of the program, and working memory per Gaussian and per pixel."""
PIXELS_OF_EACH = 80
"""Training pixels per Gaussian, which has 59 parameters; with fewer, few images are overfitted."""


class Recipe(Protocol):
    """One way to train a field."""

    def prepared(self, images: FieldImages) -> FieldImages:
        """Adapt the images to the trainer."""

    def start(self, images: FieldImages, background: np.ndarray, run: Run) -> tuple[Trainer, str]:
        """Trainer before its first step, and a note for the progress bar."""

    def write(self, folder: Path, trainer: Any, images: FieldImages) -> Any:
        """Write the field and its cameras; returns the field."""

    def facts(self, trainer: Trainer, field: Any, images: FieldImages) -> dict[str, Any]:
        """Entries of the summary."""


@dataclass(frozen=True, slots=True)
class GaussianRecipe:
    """3D Gaussians around a local origin; their number depends on time, pixels and memory."""

    config: SplatConfig

    def prepared(self, images: FieldImages) -> FieldImages:
        """Use coordinates around a local origin, because single precision is too coarse far from it."""
        return images.about_origin()

    def start(self, images: FieldImages, background: np.ndarray, run: Run) -> tuple[Trainer, str]:
        """Gaussians at the model's points, at stereo points or at random."""
        most = _fitting(self.config, images)
        config = replace(self.config, max_gaussians=most)
        start = first_gaussians(images, config, most, partial(run.report, "start"))
        run.warnings += start.warnings
        gigabytes = 1e-9 * _memory(images, most, config.sh_degree)
        note = f"up to {most:,} Gaussians on {len(images.train)} images, about {gigabytes:.1f} GB"
        return SplatTrainer(images.train, start.cloud, config, background), note

    def write(self, folder: Path, trainer: Any, images: FieldImages) -> Any:
        """Write `splat.ply` and `cameras.json` in world coordinates."""
        cloud = replace(trainer.cloud, origin_in_world=images.origin_in_world)
        write_gaussian_ply(folder / SPLAT, cloud)
        write_cameras(folder / CAMERAS, trainer.posed_views, images.origin_in_world, images.georeference)
        return cloud

    def facts(self, trainer: Trainer, field: Any, images: FieldImages) -> dict[str, Any]:
        """Number of Gaussians, filter, first view, origin."""
        view = first_view_of(field.means_in_world, images.train, images.origin_in_world)
        found = {"num_gaussians": len(trainer), ANTIALIASED: self.config.antialiased, FIRST_VIEW: view}
        return found | ({ORIGIN: images.origin_in_world.tolist()} if images.origin_in_world.any() else {})


@dataclass(frozen=True, slots=True)
class RayRecipe:
    """A field rendered by ray marching: an explicit grid or hashed tables."""

    config: NerfConfig

    @property
    def file(self) -> str:
        """Name of the field's file."""
        return KINDS[self.config.kind].file

    def prepared(self, images: FieldImages) -> FieldImages:
        """Return the images unchanged."""
        return images

    def start(self, images: FieldImages, background: np.ndarray, run: Run) -> tuple[Trainer, str]:
        """Empty field around what the cameras see."""
        run.report("start", 0, 1)
        trainer = KINDS[self.config.kind].trainer(images.train, background, self.config.seed)
        run.report("start", 1, 1)
        return trainer, ""

    def write(self, folder: Path, trainer: Trainer, images: FieldImages) -> Any:
        """Write `hash.npz` or `grid.npz`, and `cameras.json`."""
        KINDS[self.config.kind].write(folder / self.file, trainer.field)
        write_cameras(folder / CAMERAS, images.train, georeference=images.georeference)
        return trainer.field

    def facts(self, trainer: Trainer, field: Any, images: FieldImages) -> dict[str, Any]:
        """Kind, size, first view."""
        kind = KINDS[self.config.kind]
        view = first_view_of(kind.positions(field), images.train)
        return {"kind": self.config.kind, kind.count: len(trainer), FIRST_VIEW: view}


def _memory(images: FieldImages, count: int, sh_degree: int) -> float:
    """Memory in bytes for training `count` Gaussians, including the images at three resolutions."""
    views = [*images.train, *images.test]
    num_bytes = sum(view.image.nbytes for view in views) * 21 / 16
    largest = max(view.camera.width * view.camera.height for view in views)
    numbers = 3 * (11 + 3 * (1 + sh_degree) ** 2)
    return PROGRAM_BYTES + num_bytes + WORK_BYTES_OF_PIXEL * largest + (4 * numbers + WORK_BYTES) * count


def _fitting(config: SplatConfig, images: FieldImages) -> int:
    """Maximum number of Gaussians.

    Raises:
        ConfigError: the memory limit is too small for the images or for the requested number.
    """
    requested = config.max_gaussians
    most = _borne(images, config) if requested is None else requested
    if config.memory_gb is None:
        return most
    none = _memory(images, 0, config.sh_degree)
    each = _memory(images, 1, config.sh_degree) - none
    fits = int((1e9 * config.memory_gb - none) / each)
    if fits < (LEAST_POINTS if requested is None else requested):
        needs = _memory(images, LEAST_POINTS if requested is None else requested, config.sh_degree)
        raise ConfigError(
            f"memory_gb is {config.memory_gb:g}, but {needs / 1e9:.2f} GB are needed for these images and"
            f" {LEAST_POINTS if requested is None else requested:,} Gaussians: reduce max_side_px or"
            " max_gaussians"
        )
    return min(most, fits)


def _borne(images: FieldImages, config: SplatConfig) -> int:
    """Number of Gaussians that the training time and the number of pixels allow."""
    seconds = STEP_S * (config.steps or 0) if config.seconds is None else config.seconds
    figures = sum(view.camera.width * view.camera.height for view in images.train) / PIXELS_OF_EACH
    return max(LEAST_POINTS, int(min(BORNE * seconds**0.5, figures)))
