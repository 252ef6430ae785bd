"""Reading and writing of models in all supported formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.errors import FileFormatError
from epipole.io.colmap.model import find_model, read_colmap_model, write_colmap_model
from epipole.io.contents_in_words import what_it_is
from epipole.io.files import open_file
from epipole.io.meshes.ply import write_scene_ply
from epipole.io.meshes.usd_cameras import write_usd_cameras
from epipole.io.models.bundler import bundler_contents, write_bundler
from epipole.io.models.chan import SUFFIX as CHAN_SUFFIX
from epipole.io.models.chan import chan_contents, write_chan
from epipole.io.models.kapture import IMAGES as KAPTURE_IMAGES
from epipole.io.models.kapture import SENSORS, kapture_contents, write_kapture
from epipole.io.models.metashape import CAMERAS_XML, metashape_contents, write_metashape
from epipole.io.models.model_file import ModelFile
from epipole.io.models.opensfm import RECONSTRUCTION, opensfm_contents, write_opensfm
from epipole.io.models.realityscan import CAMERAS_CSV, realityscan_contents, write_realityscan
from epipole.io.models.realityscan import HEADER as CSV_HEADER
from epipole.io.models.transforms import read_transforms_scene, write_transforms
from epipole.scene import Reconstruction

IMAGE_FOLDER = "images"
"""Folder of the images beside a transforms.json, a bundle.out, a reconstruction.json, a cameras.xml or a
cameras.csv."""

TRANSFORMS, BUNDLE = "transforms.json", "bundle.out"

FOLDER_WRITERS: dict[str, Callable[[Reconstruction, Path], None]] = {
    "txt": lambda model, folder: write_colmap_model(model, folder, text=True),
    "bin": write_colmap_model,
    "transforms": lambda model, folder: write_transforms(model, folder / TRANSFORMS, IMAGE_FOLDER),
    "bundler": lambda model, folder: write_bundler(model, folder / BUNDLE, IMAGE_FOLDER),
    "opensfm": lambda model, folder: write_opensfm(model, folder / RECONSTRUCTION),
    "metashape": lambda model, folder: write_metashape(model, folder / CAMERAS_XML),
    "realityscan": lambda model, folder: write_realityscan(model, folder / CAMERAS_CSV),
    "kapture": write_kapture,
}
"""Writers of the formats that consist of several files."""

IMAGE_FOLDERS = {
    **dict.fromkeys(("transforms", "bundler", "opensfm", "metashape", "realityscan"), IMAGE_FOLDER),
    "kapture": KAPTURE_IMAGES,
}
"""Folder of the images, for formats whose files refer to them."""

FILE_WRITERS: dict[str, Callable[[Path, Reconstruction, np.ndarray], None]] = {
    "ply": lambda path, model, _up: write_scene_ply(path, model),
    "chan": lambda path, model, _up: write_chan(model, path),
    "usd": lambda path, model, up: write_usd_cameras(path, model, up=up),
}
"""Writers of the formats that are one file; the last argument is the upward direction in the world."""

_POINTS, _TRACKS, _RIGS, _POSITION, _TIMES = (
    "points and tracks",
    "tracks",
    "rigs",
    "the position on Earth",
    "capture times",
)
_ASPECT = "different focal lengths in x and y"
_PRINCIPAL_POINT = "principal points that are not the image center"
_NOT_STORED = {
    "transforms": (_TRACKS, _RIGS, _TIMES),
    "bundler": (_RIGS, _POSITION, _TIMES, _ASPECT, _PRINCIPAL_POINT),
    "ply": (_TRACKS, _RIGS, _TIMES),
    "metashape": (_POINTS, _RIGS, _TIMES),
    "realityscan": (_POINTS, _RIGS, _POSITION, _TIMES, _ASPECT),
    "kapture": (_POSITION, _TIMES),
    "chan": (_POINTS, _POSITION, _TIMES, _ASPECT, _PRINCIPAL_POINT),
    "usd": (_TRACKS, _RIGS, _TIMES),
}
"""Content of a model that a format cannot store."""

MODELS = (
    "models are read from an output folder of `epipole reconstruct`, a COLMAP model, a transforms.json, or files of"
    " OpenSfM, Metashape, RealityScan, Bundler, kapture or Nuke (.chan)"
)
_SUFFIXES = (".xml", ".csv", ".out", CHAN_SUFFIX)
"""Suffixes of models other than .json, of which many other files have one, too."""
_HEAD_BYTES = 4096


@checked
def read_model(source: str | Path) -> Reconstruction:
    """Read a model: an output folder, a COLMAP model, a transforms.json, or the files of another program.

    The content of a file decides, not its name: a reconstruction.json (OpenSfM), cameras as XML (Metashape) or CSV
    (RealityScan), a bundle.out (Bundler), a .chan (Nuke); or the folder of a dataset (kapture). Issues a Python warning for everything in the file that is not read.

    Args:
        source: the file, or the folder with one.

    Raises:
        FileFormatError: there is no readable model.
    """
    return model_contents(source).warned()


@checked
def model_contents(source: str | Path) -> ModelFile:
    """Read a model, and warnings about the content of its file that is not read.

    Args:
        source: as in `read_model`.

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
        return _reader_of(source)(source)
    try:
        folder = find_model(source)
    except FileFormatError:
        for name in (TRANSFORMS, RECONSTRUCTION, CAMERAS_XML, CAMERAS_CSV, BUNDLE):
            if (source / name).is_file():
                return _reader_of(source / name)(source / name)
        if (source / SENSORS).is_file():
            return kapture_contents(source)
        raise
    return ModelFile(folder, read_colmap_model(folder))


@checked
def is_model_file(path: Path) -> bool:
    """Whether a file may be a model that `read_model` reads: its suffix is .json, or its suffix and its start are those of one."""
    if not path.is_file() or path.suffix.lower() == ".json":
        return path.is_file()
    return path.suffix.lower() in _SUFFIXES and _reader_of(path) is not _transforms_contents


def _reader_of(file: Path) -> Callable[[Path], ModelFile]:
    """The reader for the content of a file; files of no known format are left to that of transforms.json."""
    with open_file(file) as stream:
        head = stream.read(_HEAD_BYTES).removeprefix(b"\xef\xbb\xbf").lstrip()
    if head.startswith(b"["):
        return opensfm_contents
    if head.startswith(b"<"):
        return metashape_contents
    if head.startswith(b"# Bundle file"):
        return bundler_contents
    if head.lower().startswith((CSV_HEADER.encode(), b"#cameras ")):
        return realityscan_contents
    if file.suffix.lower() == CHAN_SUFFIX:  # lines of numbers, as in many other files
        return chan_contents
    return _transforms_contents


def _transforms_contents(file: Path) -> ModelFile:
    scene = read_transforms_scene(file)
    return ModelFile(file, scene.reconstruction, scene.warnings)


@checked
def content_not_stored(model: Reconstruction, format: str) -> tuple[str, ...]:
    """Sentences about the content of a model that a format cannot store.

    Args:
        model: the model.
        format: a key of `FOLDER_WRITERS` or `FILE_WRITERS`.
    """
    used = [model.cameras[row] for row in sorted(set(model.camera_of_image[model.is_registered()].tolist()))]
    present = {
        _POINTS: len(model.points) > 0,
        _TRACKS: len(model.tracks.image) > 0,
        _RIGS: bool((np.diff(model.rigs.sensor_offsets) > 1).any()),
        _POSITION: model.georeference is not None,
        _TIMES: bool(np.isfinite(model.frames.timestamp_s).any()),
        _ASPECT: any(camera.K[0, 0] != camera.K[1, 1] for camera in used),
        _PRINCIPAL_POINT: any(
            (2.0 * camera.K[:2, 2] + 1.0 != [camera.width, camera.height]).any() for camera in used
        ),
    }
    return tuple(f"{format} cannot store {what}" for what in _NOT_STORED.get(format, ()) if present[what])
