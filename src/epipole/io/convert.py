"""Conversion of models between all supported formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from epipole._checks import checked
from epipole.errors import FileFormatError
from epipole.io.colmap.model import find_model, read_colmap_model, write_colmap_model
from epipole.io.contents_in_words import what_it_is
from epipole.io.models.bundler import write_bundler
from epipole.io.models.transforms import read_transforms, write_transforms
from epipole.scene import Reconstruction

ModelFormat = Literal["txt", "bin", "ply", "transforms", "bundler", "splat"]
IMAGE_FOLDER = "images"
"""Folder of the images beside a transforms.json or a bundle.out."""

TRANSFORMS = "transforms.json"

FOLDER_WRITERS: dict[str, Callable[[Reconstruction, Path], None]] = {
    "txt": lambda model, folder: write_colmap_model(model, folder, text=True),
    "bin": write_colmap_model,
    "transforms": lambda model, folder: write_transforms(model, folder / TRANSFORMS, IMAGE_FOLDER),
    "bundler": lambda model, folder: write_bundler(model, folder / "bundle.out", IMAGE_FOLDER),
}
"""Writers of the formats that consist of several files."""


MODELS = "models are read from an output folder of `epipole reconstruct`, a COLMAP model or a transforms.json"


@checked
def read_model(source: str | Path) -> Reconstruction:
    """Read the model in an output folder, a COLMAP model, or a transforms.json (or its folder).

    Raises:
        FileFormatError: there is no readable model.
    """
    source = Path(source)
    if source.suffix.lower() == ".ply" and source.is_file():
        raise FileFormatError(source, "it has points but no cameras, so it is not a model")
    if not source.exists():
        raise FileFormatError(source, f"it does not exist; {MODELS}")
    if source.is_file():
        if what := what_it_is(source):
            raise FileFormatError(source, f"not a model: {what}; {MODELS}")
        return read_transforms(source)
    try:
        folder = find_model(source)
    except FileFormatError:
        if (source / TRANSFORMS).is_file():
            return read_transforms(source / TRANSFORMS)
        raise
    return read_colmap_model(folder)
