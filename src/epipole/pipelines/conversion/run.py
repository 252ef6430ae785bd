"""The conversion job: writes a model in another format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from epipole._checks import as_path, checked
from epipole.config import ModelFormat
from epipole.errors import ConfigError, FileFormatError, WorkspaceError
from epipole.io.convert import (
    FILE_WRITERS,
    FOLDER_WRITERS,
    IMAGE_FOLDER,
    IMAGE_FOLDERS,
    content_not_stored,
    model_contents,
)
from epipole.io.files import missing_in_words
from epipole.io.gaussians.files import (
    META,
    SPLAT,
    SUFFIXES,
    WITHOUT_ORIGIN,
    gaussians_file,
    is_unpacked_sog,
    read_gaussians,
    write_gaussians,
)
from epipole.io.images.photographs import link_or_copy
from epipole.io.models.kapture import IMAGES as KAPTURE_IMAGES
from epipole.io.models.losses import losses_in
from epipole.io.names import path_inside
from epipole.runs import Job, open_run, refuse_existing, replacing_file
from epipole.runs.model_source import has_z_up, up_in_world
from epipole.scene import Reconstruction
from epipole.scene.gaussian_cloud import GaussianCloud

KIND = "convert"
_SUFFIXES_OF_FILES = (".json", ".out", ".txt", ".bin", ".ply", ".db", ".xml", ".csv", ".chan")
_FORMAT_OF_SUFFIX = {".chan": "chan", ".usda": "usd", ".usdc": "usd", ".usdz": "usd"}
_NAMES = {"ply": "scene.ply", "chan": "camera.chan", "usd": "cameras.usdc"}
"""Names of files in a folder that is given as target."""


@dataclass(frozen=True, slots=True)
class Conversion:
    """Result of `convert`."""

    out: Path
    """The folder, or the PLY file."""
    num_images: int
    """Number of images in `images/` beside the model."""
    missing: tuple[str, ...]
    """Names of the model's images that were not found."""
    warnings: tuple[str, ...] = ()
    """Images and models that the source reconstruction has lost, and content of the source that is not read; these are
    therefore not in the output."""
    losses: tuple[str, ...] = ()
    """Content that the format cannot store."""


def format_of(source: Path, target: Path) -> str | None:
    """The format given by a target's suffix; None if it is ambiguous, since several formats are folders."""
    name = target.name.lower()
    if name.endswith((".spz", ".sog", ".splat", ".compressed.ply")):
        return "splat"
    if name.endswith(".ply"):
        is_splat = source.is_file() or (source / SPLAT).is_file() or is_unpacked_sog(source / META)
        return "splat" if is_splat else "ply"
    return _FORMAT_OF_SUFFIX.get(target.suffix.lower())


@checked
def convert(source: str | Path, target: str | Path, format: str | None = None) -> Conversion:
    """Write a model in another format.

    Args:
        source: output folder of `reconstruct`, a COLMAP model, a transforms.json, or files of OpenSfM, Metashape,
            RealityScan, Bundler, kapture or Nuke (.chan); for `splat` an output folder of `splat`, or a file of Gaussians.
        target: for `ply`, `chan` and `usd` (.usda, .usdc, .usdz) a file; for `splat` a .ply, .compressed.ply, .spz, .sog or .splat file; for the other formats,
            which consist of several files, a new folder, or that of an earlier conversion of the same model, whose
            other formats stay. For formats other than COLMAP's, the images are copied (hard-linked if possible) to
            `images/` (kapture: `sensors/records_data/`), so that the paths in these files are valid.
        format: txt or bin (COLMAP), transforms (nerfstudio), bundler, opensfm, metashape, realityscan, kapture, chan
            (Nuke), usd, ply or splat; None: given by the target's suffix.

    Raises:
        ConfigError: the format is unknown or cannot represent the cameras, or is None and the suffix does not determine
            it.
        FileFormatError: there is no readable model.
        WorkspaceError: the target cannot be written, has other contents, or is a file not written by an earlier call.
    """
    source, target = as_path(source), as_path(target)
    format = format_of(source, target) if format is None else format
    if format is None:
        raise ConfigError(
            f"unknown output format of {target}: use the suffix .ply or {', '.join((*_FORMAT_OF_SUFFIX, *SUFFIXES[1:]))}, or pass "
            f"format, one of "
            f"{', '.join(get_args(ModelFormat))}"
        )
    if format not in get_args(ModelFormat):
        raise ConfigError(f"unknown format {format!r}; supported are {', '.join(get_args(ModelFormat))}")
    if not source.exists():
        raise FileFormatError(source, missing_in_words(source))
    if format == "splat":
        return _convert_gaussians(source, target)
    if format in FILE_WRITERS:
        return _convert_to_file(source, target, format)
    model, warnings = _model_of(source)
    if target.suffix.lower() in _SUFFIXES_OF_FILES and not target.is_dir():
        raise WorkspaceError(f"{target}: {format} writes several files; pass the name of a folder")
    image_folder = IMAGE_FOLDERS.get(format)
    names = _names_with_pose(model) if image_folder else []
    found = {name: path for name in names if (path := _image(source, name)) is not None}
    with open_run(Job(kind=KIND, inputs=(source,), settings={"format": format}), target) as run:
        if image_folder:
            with run.folder.replacing(image_folder, [f"{image_folder}/{name}" for name in found]):
                for name, path in found.items():
                    link_or_copy(path, run.root / image_folder / name)
        with run.folder.publish(format) as aside:  # last, so that the model's images exist when it does
            FOLDER_WRITERS[format](model, aside)
        run.finish({"num_images": len(found), "warnings": warnings})
    missing = tuple(name for name in names if name not in found)
    return Conversion(target, len(found), missing, warnings, content_not_stored(model, format))


def _model_of(source: Path) -> tuple[Reconstruction, tuple[str, ...]]:
    """The model, and warnings about what it and its file have lost."""
    contents = model_contents(source)
    return contents.reconstruction, (*losses_in(source), *contents.warnings)


def _convert_gaussians(source: Path, target: Path) -> Conversion:
    file = gaussians_file(source)
    if target.is_dir():
        raise WorkspaceError(f"{target} is a folder; pass a file name ({', '.join(SUFFIXES)})")
    refuse_existing([target], KIND, (source,))
    cloud = read_gaussians(file)
    with replacing_file(target, KIND, (source,)) as aside:
        write_gaussians(aside, cloud)
    return Conversion(target, 0, (), losses=_losses(target, cloud))


def _losses(target: Path, cloud: GaussianCloud) -> tuple[str, ...]:
    out = []
    suffix = target.suffix.lower()
    if suffix in WITHOUT_ORIGIN and cloud.origin_in_world.any():
        origin = " ".join(map(repr, cloud.origin_in_world.tolist()))
        out.append(f"{suffix} cannot store the origin {origin}: coordinates are relative to it")
    if suffix == ".splat" and cloud.sh_degree:
        out.append(
            f"{suffix} cannot store harmonics of degree {cloud.sh_degree}: colors do not depend on the viewing direction"
        )
    return tuple(out)


def _convert_to_file(source: Path, target: Path, format: str) -> Conversion:
    target = target / _NAMES[format] if target.is_dir() else target
    refuse_existing([target], KIND, (source,))
    model, warnings = _model_of(source)
    with replacing_file(target, KIND, (source,)) as aside:
        FILE_WRITERS[format](aside, model, up_in_world(model, has_z_up(model, source)))
    return Conversion(target, 0, (), warnings, content_not_stored(model, format))


def _names_with_pose(model: Reconstruction) -> list[str]:
    return [name for name, has_pose in zip(model.images.name, model.is_registered()) if has_pose]


def _image(source: Path, name: str) -> Path | None:
    """The file of an image: in `images/` of the output folder of the model, beside the model's file, or in that of a dataset.

    Raises:
        FileFormatError: the name leads out of the folder.
    """
    roots = [source.parent / IMAGE_FOLDER, source.parent]
    if source.is_dir():
        at = source.resolve()
        roots = [folder / IMAGE_FOLDER for folder in (at, at.parent, at.parent.parent)] + [
            at / KAPTURE_IMAGES
        ]
    return next((path for root in roots if (path := path_inside(root, name)).is_file()), None)
