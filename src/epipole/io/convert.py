"""A model from one file format into another."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

from epipole.errors import ConfigError, FileFormatError
from epipole.io.bundler import write_bundler
from epipole.io.colmap import read_colmap_model, write_colmap_model
from epipole.io.ply import write_scene_ply
from epipole.io.transforms_json import read_transforms, write_transforms
from epipole.scene import Reconstruction

ModelFormat = Literal["txt", "bin", "ply", "transforms", "bundler"]

_WRITERS: dict[str, Callable[[Reconstruction, Path], None]] = {
    "txt": lambda model, target: write_colmap_model(model, target, text=True),
    "bin": write_colmap_model,
    "ply": lambda model, target: write_scene_ply(target, model),
    "transforms": write_transforms,
    "bundler": write_bundler,
}
_DEFAULT_FILES = {"ply": "scene.ply", "transforms": "transforms.json", "bundler": "bundle.out"}


def convert_model(source_folder: str | Path, target: str | Path, format: str) -> Path:
    """Read a COLMAP model (or a transforms.json) and write it in another format.

    Args:
        source_folder: folder with the model.
        target: a folder for txt and bin, otherwise a file, or an existing folder in which the file gets its
            usual name.
        format: of the target, a `ModelFormat`.

    Returns:
        What was written.

    Raises:
        ConfigError: unknown format, or one that cannot hold the cameras.
        FileFormatError: there is no readable model.
        WorkspaceError: the target cannot be written.
    """
    if format not in _WRITERS:
        raise ConfigError(f"unknown format {format!r}; one of {', '.join(get_args(ModelFormat))}")
    source, target = Path(source_folder), Path(target)
    if not source.exists():
        raise FileFormatError(source, "there is no such folder")
    model = read_transforms(source) if source.suffix.lower() == ".json" else read_colmap_model(source)
    if format in _DEFAULT_FILES and target.is_dir():
        target = target / _DEFAULT_FILES[format]
    _WRITERS[format](model, target)
    return target
