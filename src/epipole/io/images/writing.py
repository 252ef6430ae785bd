"""Writing of photographs: upright copies, and images in the format given by a suffix."""

from __future__ import annotations

import io
import os
import shutil
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError, ShapeError
from epipole.io.atomic import atomic_write
from epipole.io.files import open_file, require_file
from epipole.io.images.exif import EXIF_ERRORS, GpsPosition, new_exif, orientation_of, upright_exif
from epipole.io.images.formats import FORMAT_OF_SUFFIX, format_of
from epipole.io.images.pixels import PILLOW_ERRORS, decode, exif_of, open_with_pillow

QUALITY = 97
"""Quality of lossy formats, 0 to 100."""
_LOSSY: dict[str, dict[str, Any]] = {
    "JPEG": {"subsampling": 0},
    "AVIF": {"subsampling": "4:4:4"},
    "HEIF": {"chroma": 444},
}
_WITHOUT_EXIF = ("BMP", "PPM")
_LONGEST_JPEG_SIDE = 65500


@checked
def copy_or_rotate(source: Path | str, target: Path | str) -> None:
    """Copy an image to `target` so that its pixels are as `read_rgb` returns them, without an orientation tag.

    An upright file is hard-linked (copied across file systems). A rotated one, or one whose format does not match the
    suffix of `target`, is re-encoded (JPEG at quality 97, others lossless); camera, focal length, position and time are
    kept.

    Raises:
        FileFormatError: the source cannot be read, or the suffix of `target` cannot be written.
    """
    source, target = Path(source), Path(target)
    with open_file(source) as stream:
        file_format = format_of(source, stream.read(64))
        exif = exif_of(open_with_pillow(source, stream, file_format))
    if orientation_of(exif) == 1 and file_format == _format_of_target(target):
        link_or_copy(source, target)
        return
    write_photograph(target, decode(source, target.suffix.lower() == ".pgm", None), exif)


@checked
def write_photograph(
    path: Path, pixels: UInt8[np.ndarray, "h w *channels"], exif: Image.Exif | None = None
) -> None:
    """Write gray or RGB in the format given by the suffix: JPEG, AVIF and HEIC at quality 97, others lossless.

    Args:
        path: the file.
        pixels: upright pixels.
        exif: camera metadata; its orientation is dropped.

    Raises:
        FileFormatError: the suffix is not that of a format that can be written here.
        ShapeError: the pixels are not gray, RGB or RGBA, or the array is empty.
        WorkspaceError: the file cannot be written.
    """
    content = encoded_photograph(path, pixels, exif)
    with atomic_write(path) as part:
        part.write_bytes(content)


@checked
def encoded_photograph(
    path: Path, pixels: UInt8[np.ndarray, "h w *channels"], exif: Image.Exif | None = None
) -> bytes:
    """The content of the file that `write_photograph` writes.

    Args:
        path: the file, whose suffix gives the format.
        pixels: upright pixels.
        exif: camera metadata; its orientation is dropped.

    Raises:
        FileFormatError: the suffix is not that of a format that can be written here.
        ShapeError: the pixels are not gray, RGB or RGBA, or the array is empty.
    """
    if not pixels.size or pixels.shape[2:] not in ((), (3,), (4,)):
        raise ShapeError(f"pixels must be a non-empty (h, w), (h, w, 3) or (h, w, 4), got {pixels.shape}")
    target_format = _format_of_target(path)
    options: dict[str, Any] = {"lossless": True} if target_format == "WEBP" else {}
    if target_format in _LOSSY:
        options = {"quality": QUALITY, **_LOSSY[target_format]}
    if exif is not None and target_format not in _WITHOUT_EXIF:
        options |= _kept_exif(exif)
    image, encoded = Image.fromarray(np.ascontiguousarray(pixels)), io.BytesIO()
    try:
        if target_format == "HEIF":
            import_module("pillow_heif").from_pillow(image).save(encoded, format="HEIF", **options)
        else:
            image.save(encoded, target_format, **options)
    except (*PILLOW_ERRORS, ImportError) as error:
        problem = f"cannot write {target_format} here ({error})"
        raise FileFormatError(path, f"{problem}; convert the image to JPEG or PNG first") from error
    return encoded.getvalue()


def _format_of_target(path: Path) -> str:
    found = FORMAT_OF_SUFFIX.get(path.suffix.lower())
    if found is None:
        problem = "cannot write this format; convert the image to JPEG, PNG or TIFF first"
        raise FileFormatError(path, problem)
    return found


@checked
def write_jpeg_with_exif(
    path: Path | str,
    rgb: UInt8[np.ndarray, "h w 3"],
    *,
    focal_35mm: float | None = None,
    make: str = "epipole",
    model: str = "synthetic",
    gps: GpsPosition | tuple[float, float, float | None] | None = None,
    quality: int = 95,
) -> None:
    """Write a rendered photograph as JPEG with EXIF camera data (35 mm equivalent rounded to mm).

    Raises:
        ConfigError: a number is outside the range of EXIF or JPEG, or the image is empty or larger than JPEG allows.
        WorkspaceError: the file cannot be written.
    """
    if not 1 <= quality <= 100:
        raise ConfigError(f"quality must be from 1 to 100, got {quality}")
    if not (rgb.size and max(rgb.shape) <= _LONGEST_JPEG_SIDE):
        raise ConfigError(
            f"the sides of a JPEG must have 1 to {_LONGEST_JPEG_SIDE} pixels, got {rgb.shape[1]} x {rgb.shape[0]}"
        )
    exif = new_exif(make, model, focal_35mm, gps).tobytes()
    with atomic_write(path) as part:
        Image.fromarray(np.ascontiguousarray(rgb)).save(part, "JPEG", quality=quality, exif=exif)


def _kept_exif(exif: Image.Exif) -> dict[str, bytes]:
    """The tags that can be written; none if their values have types that the tags do not allow."""
    try:
        return {"exif": upright_exif(exif).tobytes()}
    except (*EXIF_ERRORS, AttributeError):
        return {}


@checked
def link_or_copy(source: Path, target: Path) -> None:
    """Hard-link a file to `target`, or copy it if that is impossible (another disk).

    Raises:
        FileFormatError: the source does not exist.
        WorkspaceError: the target cannot be written.
    """
    require_file(source)
    if target.exists() and source.samefile(target):
        return
    with atomic_write(target) as part:
        try:
            os.link(source.resolve(), part)
        except OSError:
            shutil.copy2(source, part)
