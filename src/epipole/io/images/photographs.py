"""Photographs: listing, headers, pixels, masks.

Every image is returned upright (EXIF orientation applied), as 8-bit grayscale or RGB. Other formats are converted:

- 16-bit, 32-bit and float grayscale is stretched so that its 0.1 and 99.9 percentiles become 0 and 255 (such
  files often use a fraction of their range); if these are equal, the full range of the type is used. For a set of
  images that must be mapped alike, use the range of the set (`common_range`);
- 16-bit color keeps the upper 8 of its sensor's bits: 8, 10, 12, 14 or 16, by the largest value (`deep_pixels`);
- transparency is composited on black; palette and CMYK become RGB; grayscale whose zero is white is inverted;
- animations (WebP, AVIF), multi-page TIFFs and camera RAW are rejected. The content determines the format, not the
  suffix.

JPEG is decoded at 1/2, 1/4 or 1/8 if a smaller image is requested, so that memory depends on the result and not on
the file (a progressive JPEG still needs its coefficients, about 3 bytes per pixel). Other formats are limited to 150
megapixels.
"""

from __future__ import annotations

import io
import os
import stat
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Bool, UInt8

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.io._spherical import refuse_panorama
from epipole.io.files import file_bytes, missing_in_words, open_file
from epipole.io.images.deep_pixels import GrayRange as GrayRange
from epipole.io.images.exif import (
    FocalSource,
    GpsPosition,
    camera_of,
    capture_time_of,
    focal_of,
    gimbal_up_of,
    gps_of,
    gps_sigma_of,
    orientation_of,
)
from epipole.io.images.formats import (
    AVIF_SUFFIXES,
    FORMAT_OF_SUFFIX,
    HEIF_SUFFIXES,
    OTHER_SUFFIXES,
    RAW_SUFFIXES,
    format_of,
)
from epipole.io.images.image_names import name_problem, printable
from epipole.io.images.pixels import common_range as common_range
from epipole.io.images.pixels import (
    decode,
    exif_of,
    open_with_pillow,
    pillow_pixels,
    readable_suffixes,
    refuse_huge,
    rotation,
    stored_size,
)
from epipole.io.images.writing import copy_or_rotate as copy_or_rotate
from epipole.io.images.writing import link_or_copy as link_or_copy
from epipole.io.images.writing import write_jpeg_with_exif as write_jpeg_with_exif
from epipole.io.passed_over import files_below, passed_over_in_words


@dataclass(frozen=True, slots=True)
class PhotographList:
    """Photographs in a folder."""

    folder: Path
    names: tuple[str, ...]
    """Sorted paths of readable images, relative to the folder, with forward slashes."""
    unreadable: tuple[str, ...]
    """Images in unsupported formats, unless a readable image has the same name."""
    advice: str
    """What to do about the unreadable images; empty if there are none."""
    unusable: Mapping[str, str] = field(default_factory=dict)
    """Image files that are not listed, and why: pipes, sockets and devices, which are never opened, and names that
    image lists cannot contain (escaped here)."""
    passed_over: tuple[str, ...] = ()
    """Sentences about other files and folders of results in the folder that are not listed."""

    @property
    def notes(self) -> list[str]:
        """Everything that is not listed, as sentences."""
        unusable = [f"Skipped {name}: {why}" for name, why in self.unusable.items()]
        return [*([self.advice] if self.advice else []), *unusable, *self.passed_over]

    def require_some(self) -> PhotographList:
        """The list itself, if it is not empty.

        Raises:
            FileFormatError: the list is empty; the message describes what the folder contains instead.
        """
        if not self.names:
            raise FileFormatError(self.folder, "; ".join(["it contains no images", *self.notes]))
        return self

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"PhotographList({len(self.names)} in {self.folder}, {len(self.unreadable)} unreadable)"


@dataclass(frozen=True, slots=True)
class PhotographHeader:
    """An image's metadata, read without decoding its pixels."""

    width: int
    """Upright, in pixels."""
    height: int
    orientation: int
    """EXIF orientation of the stored pixels, 1 to 8."""
    make: str
    model: str
    focal_px: float | None
    focal_source: FocalSource | None
    gps: GpsPosition | None
    capture_time: datetime | None
    """Local time on the camera's clock."""
    is_deep_gray_png: bool = False
    """Whether it is a 16-bit gray PNG, as used for depth."""
    up_in_camera: tuple[float, float, float] | None = None
    """Direction of up in camera coordinates as measured by a gimbal; None if the XMP block has none."""
    gps_sigma_m: tuple[float, float, float] | None = None
    """Standard deviations of the GPS position, east, north and up; None if not recorded."""


@checked
def list_photographs(folder: Path | str, *, ignore: Sequence[Path | str] = ()) -> PhotographList:
    """List the photographs in a folder and its sub-folders.

    Hidden files and folders are ignored, as are sub-folders with results (a `config.json` or a `database.db`).

    Args:
        folder: the folder to search.
        ignore: further folders to skip (masks, the output folder), and files that have another use.

    Raises:
        FileFormatError: there is no such folder, or it or one of its sub-folders cannot be listed.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileFormatError(
            folder,
            "this is a file, not a folder of photographs; pass its folder"
            if folder.exists()
            else missing_in_words(folder),
        )
    readable_here = readable_suffixes()
    known = frozenset(FORMAT_OF_SUFFIX) | RAW_SUFFIXES | OTHER_SUFFIXES
    ignored, results = {Path(p).resolve() for p in ignore}, list[Path]()
    every = sorted(files_below(folder, ignored, results))
    found = [n for n in every if _suffix(n) in known]
    # realpath, since Path.resolve refuses links that form a circle.
    others = [
        n for n in every if _suffix(n) not in known and Path(os.path.realpath(folder / n)) not in ignored
    ]
    unusable = {n: why for n in found if (why := _file_problem(folder / n) or name_problem(n))}
    names = [n for n in found if n not in unusable]
    readable = [n for n in names if _suffix(n) in readable_here]
    stems = {PurePosixPath(n).with_suffix("") for n in readable}
    unreadable = [
        n for n in names if _suffix(n) not in readable_here and PurePosixPath(n).with_suffix("") not in stems
    ]
    escaped = {printable(n): why for n, why in unusable.items()}
    passed_over = passed_over_in_words(folder, others, results)
    return PhotographList(
        folder, tuple(readable), tuple(unreadable), _advice(unreadable), escaped, tuple(passed_over)
    )


@checked
def read_header(path: Path | str) -> PhotographHeader:
    """Read an image's size, camera, focal length, position and time from its header.

    Raises:
        FileFormatError: the file is not an image in a known format.
        MissingDependencyError: the image is HEIC and pillow-heif is not installed.
    """
    path = Path(path)
    with open_file(path) as stream:
        file_format = format_of(path, stream.read(64))
        image = open_with_pillow(path, stream, file_format)
        refuse_panorama(path, image)
        exif = exif_of(image)
        orientation = orientation_of(exif)
        width, height = stored_size(image)
        is_deep_gray_png = file_format == "PNG" and image.mode.startswith("I")
    if orientation >= 5:
        width, height = height, width
    focal, (make, model) = focal_of(exif, width, height), camera_of(exif)
    return PhotographHeader(
        width,
        height,
        orientation,
        make,
        model,
        focal.focal_px if focal else None,
        focal.source if focal else None,
        gps_of(exif),
        capture_time_of(exif),
        is_deep_gray_png,
        gimbal_up_of(image.info.get("xmp")) if orientation == 1 else None,
        gps_sigma_of(exif, image.info.get("xmp")),
    )


@checked
def read_gray(
    path: Path | str,
    max_size_px: int | None = None,
    *,
    limits: GrayRange | None = None,
    orientation: int | None = None,
) -> UInt8[np.ndarray, "h w"]:
    """Read an image upright as 8-bit grayscale (luma 0.299 R + 0.587 G + 0.114 B).

    Args:
        path: the image.
        max_size_px: longest side of the result; a larger image is shrunk by area averaging. Its pixel x
            corresponds to (x + 0.5) * width / result width - 0.5 in the full image. None: full size.
        limits: values of deep grayscale that become 0 and 255 (`common_range`); None: its own percentiles.
        orientation: applied instead of the file's EXIF orientation; 1: pixels as stored. None: the file's.

    Raises:
        ConfigError: the range of limits is empty or infinite.
        FileFormatError: the image is damaged, truncated, too large, or the file is not an image.
        MissingDependencyError: the image is HEIC and pillow-heif is not installed.
    """
    return decode(Path(path), True, max_size_px, limits, orientation)


@checked
def read_rgb(
    path: Path | str,
    max_size_px: int | None = None,
    *,
    limits: GrayRange | None = None,
    orientation: int | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image upright as 8-bit RGB.

    Args:
        path: the image.
        max_size_px: longest side of the result, as in `read_gray`.
        limits: as in `read_gray`.
        orientation: as in `read_gray`.

    Raises:
        ConfigError: the range of limits is empty or infinite.
        FileFormatError: the image is damaged, truncated, too large, or the file is not an image.
        MissingDependencyError: the image is HEIC and pillow-heif is not installed.
    """
    return decode(Path(path), False, max_size_px, limits, orientation)


@checked
def mask_of(mask_folder: Path | str, name: str) -> Path | None:
    """The mask file of an image, by the naming rules of `read_mask`; None if there is none."""
    for candidate in mask_names(name):
        path = Path(mask_folder) / candidate
        with suppress(OSError):  # appending .png can exceed the longest file name
            if path.is_file():
                return path
    return None


@checked
def mask_names(name: str) -> tuple[str, str]:
    """Possible names of an image's mask, in order of preference.

    Raises:
        ConfigError: the image name is not valid.
    """
    if not PurePosixPath(name).name:
        raise ConfigError(f"name must be an image name, got {name!a:.60}")
    return f"{name}.png", str(PurePosixPath(name).with_suffix(".png"))


@checked
def read_mask(
    mask_folder: Path | str, name: str, *, size: tuple[int, int] | None = None
) -> Bool[np.ndarray, "h w"] | None:
    """Read the mask of an image: NAME.png (photo.jpg.png), else NAME with the suffix .png (photo.png).

    Args:
        mask_folder: folder of masks, laid out like the folder of images.
        name: the image's name, relative to its folder.
        size: upright (width, height) of the image, which the mask must have.

    Returns:
        True where the image is used (mask not black and not transparent); None if there is no mask.

    Raises:
        FileFormatError: the mask is damaged or differs from the image in size.
    """
    path = mask_of(mask_folder, name)
    return None if path is None else read_mask_file(path, name, size=size)


@checked
def read_mask_file(path: Path, name: str, *, size: tuple[int, int] | None = None) -> Bool[np.ndarray, "h w"]:
    """Read a mask from a known file, as in `read_mask`.

    Raises:
        FileFormatError: the mask is missing, damaged or differs from the image in size.
    """
    data = file_bytes(path)
    image = open_with_pillow(path, io.BytesIO(data), format_of(path, data[:64]))
    refuse_huge(path, image, data)
    pixels, orientation = pillow_pixels(path, image, data)
    keep = np.ascontiguousarray((pixels != 0).any(axis=2) if pixels.ndim == 3 else pixels != 0)
    keep = rotation(keep.view(np.uint8), orientation).view(bool)
    if size is not None and keep.shape != (size[1], size[0]):
        h, w = keep.shape
        raise FileFormatError(path, f"the mask is {w} x {h} but its image {name} is {size[0]} x {size[1]}")
    return keep


def _suffix(name: str) -> str:
    return PurePosixPath(name).suffix.lower()


def _file_problem(path: Path) -> str:
    """Why a file must not be opened (a pipe, a socket or a device); empty for a regular file or a broken link."""
    with suppress(OSError):
        if not stat.S_ISREG(path.stat().st_mode):
            return "it is a pipe, a socket or a device, not a regular file"
    return ""


def _advice(unreadable: Sequence[str]) -> str:
    kinds = (
        ("HEIC", HEIF_SUFFIXES, "run `pip install pillow-heif` to read them, or convert them to JPEG"),
        ("AVIF", AVIF_SUFFIXES, "run `pip install --upgrade Pillow` to read them, or convert them to JPEG"),
        (
            "RAW",
            RAW_SUFFIXES,
            "develop them to JPEG or TIFF first (with darktable or RawTherapee, for example)",
        ),
        ("GIF, JPEG 2000, JPEG XL, PSD, EXR or TGA", OTHER_SUFFIXES, "convert them to PNG or JPEG"),
    )
    sentences = []
    for kind, suffixes, remedy in kinds:
        found = [n for n in unreadable if _suffix(n) in suffixes]
        if found:
            files = "file is" if len(found) == 1 else "files are"
            sentences.append(f"{len(found)} {kind} {files} skipped (such as {found[0]}): {remedy}.")
    return " ".join(sentences)
