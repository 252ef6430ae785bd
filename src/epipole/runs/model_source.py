"""A model of any format with the folder of its images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from epipole._checks import check_fields, checked
from epipole.errors import FileFormatError
from epipole.io.colmap.model import find_model, read_colmap_model
from epipole.io.contents_in_words import MARK
from epipole.io.models.llff import LLFF, read_llff
from epipole.io.models.transforms import read_transforms_scene
from epipole.io.names import path_inside
from epipole.runs.folder import has_own_model, read_mark
from epipole.runs.output_kind import is_output_of
from epipole.scene import Reconstruction

SPLITS = ("transforms_train.json", "transforms_test.json")
"""Splits of NeRF-synthetic scenes; the validation split is not used."""
Z_UP_KINDS = ("reconstruct", "slam", "merge", "georeference")
"""Commands that make +z the upward direction."""
UNDISTORTED = "undistort"
"""The command that keeps the upward direction of its source."""
_MOST_STEPS = 8
"""Number of undistorted models of undistorted models."""
_LEAST_LENGTH = 1e-6
"""Length of the mean of unit vectors below which it has no direction."""
_AGREEING_UP, _SAME_VIEW = 0.7, 0.9
"""Lengths of the mean of the upward axes below which they disagree, and of the mean viewing direction above which the cameras look the same way."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelSource:
    """A model and its images."""

    model: Reconstruction
    folder: Path
    """Folder that image names are relative to."""
    is_own: bool = False
    """Whether epipole made the model, so that it describes upright images."""
    has_z_up: bool = False
    """Whether +z is up: in models of epipole, and in georeferenced ones."""
    masks: Mapping[str, Path] = field(default_factory=dict)
    """Masks by image name."""
    splits: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Image names of the splits train, val and test."""
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ConfigError: a field has the wrong type.
        """
        check_fields(self)


@checked
def is_model(source: Path) -> bool:
    """Whether a source has cameras; otherwise it is a folder of photographs or a video."""
    if source.suffix == ".json":
        return True
    if any((source / name).is_file() for name in (SPLITS[0], "transforms.json", LLFF)):
        return True
    try:
        find_model(source)
    except FileFormatError:
        return False
    return True


@checked
def model_source_of(source: Path, max_side_px: int, photographs: Path | None = None) -> ModelSource:
    """Read a model of any format.

    Args:
        source: an output folder of `reconstruct`, a COLMAP model with `images` next to it, a transforms.json, or a folder with one or with
            LLFF's poses_bounds.npy.
        max_side_px: longer side at which the images will be used: LLFF has images of several sizes.
        photographs: folder of the images, if not next to the model.

    Raises:
        FileFormatError: there is none, or it is damaged.
    """
    file = source if source.suffix == ".json" else source / "transforms.json"
    if (source / LLFF).is_file():
        scene = read_llff(source, max_side_px)
        found = ModelSource(scene.reconstruction, scene.image_folder)
    elif file.is_file():
        found = transforms_source(file)
    else:
        folder = find_model(source)
        at = folder.resolve()
        positions = (source, folder, at.parent, at.parent.parent)
        workspace = next((position for position in positions if (position / "images").is_dir()), source)
        model, is_own = read_colmap_model(folder), has_own_model(workspace)
        found = ModelSource(model, workspace / "images", is_own, has_z_up(model, workspace))
    return found if photographs is None else replace(found, folder=photographs)


@checked
def transforms_source(file: Path) -> ModelSource:
    """Read a transforms.json with its masks and splits.

    Raises:
        FileFormatError: it is damaged.
    """
    scene = read_transforms_scene(file, image_folder="")
    masks = {name: path_inside(file.parent, mask) for name, mask in scene.masks.items()}
    warnings = tuple(f"{file.name}: {warning}" for warning in scene.warnings)
    is_on_earth = scene.reconstruction.georeference is not None
    return ModelSource(scene.reconstruction, file.parent, False, is_on_earth, masks, scene.splits, warnings)


@checked
def has_z_up(model: Reconstruction, source: Path) -> bool:
    """Whether +z is up in a model: it is georeferenced, or epipole made it or the model that it undistorted.

    Args:
        model: the model.
        source: the output folder that the model is from, or the model's folder in it.
    """
    if model.georeference is not None:
        return True
    at = source.resolve()
    for _ in range(_MOST_STEPS):
        workspace = next((folder for folder in (at, at.parent.parent) if (folder / MARK).is_file()), None)
        if workspace is None:
            return False
        if not is_output_of(workspace, UNDISTORTED):
            return any(is_output_of(workspace, kind) for kind in Z_UP_KINDS)
        mark = read_mark(workspace)
        paths = mark.source.paths if mark is not None else ()
        if not paths:
            return False
        at = Path(paths[0])
    return False


@checked
def up_in_world(model: Reconstruction, is_z_up: bool) -> Float64[np.ndarray, " 3"]:
    """The upward direction: +z if the model is known to have it, else a guess from the cameras.

    It is the mean of their upward axes. If these point in different directions while all cameras look the same way, as in a flight that
    looks down on each line in the other direction, it is the direction that they come from.

    Args:
        model: the model.
        is_z_up: whether +z is known to be up.
    """
    rotations = model.cams_from_world()[np.flatnonzero(model.is_registered())].rotation
    mean = -rotations[:, 1].mean(axis=0) if len(rotations) else np.zeros(3)
    length = float(np.linalg.norm(mean))
    ahead = rotations[:, 2].mean(axis=0) if len(rotations) else np.zeros(3)
    if not is_z_up and length < _AGREEING_UP and np.linalg.norm(ahead) > _SAME_VIEW:
        return np.asarray(-ahead / np.linalg.norm(ahead))
    return np.array([0.0, 0.0, 1.0]) if is_z_up or length < _LEAST_LENGTH else np.asarray(mean / length)
