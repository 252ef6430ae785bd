"""The files of a SOG, a zip or a folder with meta.json and images; sizes are checked, since meta.json may be wrong."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngImageFile
from PIL.WebPImagePlugin import WebPImageFile

from epipole.errors import FileFormatError
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes, problem_of_name
from epipole.io.gaussians._finite import MOST_GAUSSIANS
from epipole.io.images.pixels import PILLOW_ERRORS
from epipole.io.json_files import json_values
from epipole.io.names import path_inside

META = "meta.json"
_PARTS = {"means": 2, "scales": 1, "quats": 1, "sh0": 1, "shN": 2}
"""Entries of meta.json, and their numbers of images."""
_MOST_META, _MOST_MEMBER = 1 << 22, 1 << 29
"""Largest size of meta.json, and of an image in a folder, bytes."""
_SMALL, _MOST_PX, _MOST_PER_BYTE = 1 << 20, 8, 2
"""Pixels or Gaussians allowed in any file; beyond, pixels per Gaussian and Gaussians per byte (0.1 in real files)."""
_DAMAGE = (
    ValueError,
    KeyError,
    OSError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    RuntimeError,
    MemoryError,
    struct.error,
)
"""Exceptions that zipfile raises on damaged files."""


def is_sog(path: Path) -> bool:
    """Whether a file is a zip with a meta.json."""
    try:
        with zipfile.ZipFile(path) as archive:
            return META in archive.namelist()
    except _DAMAGE:
        return False


def is_unpacked_sog(path: Path) -> bool:
    """Whether a file is the meta.json of an unpacked SOG; other programs use that name, too."""
    if path.name.lower() != META or not path.is_file():
        return False
    try:
        _meta(path, file_bytes(path, _MOST_META))
    except FileFormatError:
        return False
    return True


def in_folder(path: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The content of a meta.json, and the images beside it by name."""
    meta = _meta(path, file_bytes(path, _MOST_META))
    return meta, {
        name: file_bytes(path_inside(path.parent, name), _MOST_MEMBER) for name in _names(path, meta)
    }


def in_archive(path: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The content of meta.json in a zip, and its images by name; nothing is unpacked to disk."""
    data = file_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:

            def member(name: str, most: int) -> bytes:
                with archive.open(name) as stream:
                    found = stream.read(most + 1)
                if len(found) > most:
                    raise FileFormatError(path, f"{name!a} unpacks to more than {most} bytes")
                return found

            meta = _meta(path, member(META, _MOST_META))
            # Images are already compressed: a member that a zip makes much smaller is not an image.
            return meta, {name: member(name, 4 * len(data) + _SMALL) for name in _names(path, meta)}
    except FileFormatError:
        raise
    except _DAMAGE as error:
        raise FileFormatError(path, f"not a SOG file, or damaged ({error})") from error


def _meta(path: Path, data: bytes) -> dict[str, Any]:
    """Parse meta.json and check that its entries are present.

    Raises:
        FileFormatError: it is not JSON, has an unsupported version, or lacks an entry.
    """
    try:
        meta = json_values(path, data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise FileFormatError(path, f"{META} is not UTF-8 text") from error
    if not isinstance(meta, dict):
        raise FileFormatError(path, f"{META} is not a JSON object")
    if meta.get("version", 1) not in (1, 2):
        raise FileFormatError(path, f"unsupported SOG version {meta['version']!a} (not 1 or 2)")
    for part, number in _PARTS.items():
        given = meta.get(part)
        if part == "shN" and not given:
            continue
        files = given.get("files") if isinstance(given, dict) else None
        if not isinstance(files, list) or len(files) < number:
            raise FileFormatError(path, f"{META} does not name the images of {part}")
    return meta


def _names(path: Path, meta: Mapping[str, Any]) -> list[str]:
    """Names of all images, without duplicates.

    Raises:
        FileFormatError: a name is not a valid file name.
    """
    parts = [(part, number) for part, number in _PARTS.items() if meta.get(part)]
    names = [name for part, number in parts for name in meta[part]["files"][:number]]
    problem = next(filter(None, map(problem_of_name, names)), None)
    if problem:
        raise FileFormatError(path, f"{META}: {problem}")
    return list(dict.fromkeys(names))


def count_of(path: Path, meta: Mapping[str, Any], num_bytes: int) -> int:
    """Number of Gaussians; version 1 stores it as the shape of the means.

    Raises:
        FileFormatError: the number is missing, or too large for `num_bytes`.
    """
    given = meta.get("count")
    if given is None:
        shape = meta["means"].get("shape")
        given = shape[0] if isinstance(shape, list) and shape else None
    if not isinstance(given, int) or isinstance(given, bool) or given < 1:
        raise FileFormatError(path, f"{META} has no number of Gaussians")
    if given > min(MOST_GAUSSIANS, max(_SMALL, _MOST_PER_BYTE * num_bytes)):
        raise FileFormatError(path, f"{given} Gaussians cannot fit into {num_bytes} bytes")
    return given


def decoded(path: Path, name: str, data: bytes, count: int) -> np.ndarray:
    """Decode an image to (h, w, 4) uint8, without changing its values.

    Raises:
        FileFormatError: it is damaged, not an image, or much larger than `count` pixels.
    """
    is_webp = data[:4] == b"RIFF" and data[8:12] == b"WEBP"
    if not is_webp and data[:8] != b"\x89PNG\r\n\x1a\n":
        raise FileFormatError(path, f"{name!a} is not a WebP or PNG image")
    reader: Callable[[io.BytesIO], Image.Image] = WebPImageFile if is_webp else PngImageFile
    try:
        with reader(io.BytesIO(data)) as image:
            if image.width * image.height > max(_SMALL, _MOST_PX * count):
                sizes = f"{image.width} x {image.height}"
                raise FileFormatError(path, f"{name!a} is too large: {sizes} pixels for {count}")
            if image.mode not in ("RGB", "RGBA"):
                raise FileFormatError(path, f"{name!a} does not have three 8-bit colors ({image.mode})")
            return np.asarray(image.convert("RGBA"))
    except FileFormatError:
        raise
    except PILLOW_ERRORS as error:
        raise FileFormatError(path, f"{name!a} is damaged ({error})") from error


def write_archive(path: Path, meta: Mapping[str, Any], images: Mapping[str, np.ndarray]) -> None:
    """Write an uncompressed zip, since WebP is already compressed; the output is deterministic."""
    with atomic_write(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
        for name, image in images.items():
            data = io.BytesIO()
            # exact: keep colors where alpha is 0. Higher effort takes seconds and saves nothing.
            Image.fromarray(image).save(data, "WEBP", lossless=True, exact=True, method=4, quality=75)
            archive.writestr(_member(name), data.getvalue())
        archive.writestr(_member(META), json.dumps(meta, allow_nan=False))


def _member(name: str) -> zipfile.ZipInfo:
    """A zip entry without a date, and readable once unpacked."""
    member = zipfile.ZipInfo(name)
    member.external_attr = 0o644 << 16
    return member
