"""Rejection of spherical images and cameras, for which there is no camera model."""

from __future__ import annotations

import re
from pathlib import Path
from typing import IO

from PIL.ImageFile import ImageFile
from PIL.TiffImagePlugin import TiffImageFile

from epipole.errors import FileFormatError

SPHERICAL_REFUSAL = (
    "spherical (equirectangular) images are not supported; render perspective views of them first"
)

_WORDS = ("equirect", "spherical", "latlong", "lonlat", "latlon", "panoram", "omnidirectionalstereo", "vr180")
# Google's spherical video: version 1 is XML in a box, version 2 the box sv3d that starts with svhd.
_SPHERICAL_VIDEO = re.compile(rb"Spherical>\s*true\s*<|sv3d....svhd", re.DOTALL)
_MOST_BOXES, _MOST_INDEX_BYTES = 1000, 1 << 25
_TIFF_XMP = 700
_PROJECTION = re.compile(rb"ProjectionType\s*(?:=\s*[\"']|>)\s*([A-Za-z]{1,40})")
_PLANE = (b"perspective", b"rectilinear")


def is_spherical_word(word: str) -> bool:
    """Whether a camera model name or a key denotes a spherical image."""
    return any(known in word.lower() for known in _WORDS)


def refuse_panorama(path: Path, image: ImageFile) -> None:
    """Reject an image whose XMP block names a non-planar projection (Google's GPano:ProjectionType).

    Raises:
        FileFormatError: the image is a panorama.
    """
    xmp = image.tag_v2.get(_TIFF_XMP) if isinstance(image, TiffImageFile) else image.info.get("xmp")
    data = xmp.encode(errors="replace") if isinstance(xmp, str) else xmp
    found = _PROJECTION.search(data) if isinstance(data, bytes) else None
    if found is not None and found[1].lower() not in _PLANE:
        projection = found[1].decode()
        raise FileFormatError(path, f"its metadata say ProjectionType {projection}: {SPHERICAL_REFUSAL}")


def refuse_spherical_video(path: Path, stream: IO[bytes]) -> None:
    """Reject an MP4 or MOV file whose index marks its frames as spherical.

    Raises:
        FileFormatError: the video is spherical.
    """
    if _SPHERICAL_VIDEO.search(_index_of(stream)):
        raise FileFormatError(path, f"its metadata say that the video is spherical: {SPHERICAL_REFUSAL}")


def _index_of(stream: IO[bytes]) -> bytes:
    """The moov box (ISO 14496-12), truncated if long; empty for files of other formats."""
    position = 0
    for _ in range(_MOST_BOXES):
        stream.seek(position)
        head = stream.read(16)
        size = int.from_bytes(head[:4], "big")
        size = int.from_bytes(head[8:16], "big") if size == 1 else size
        if len(head) < 8 or (position == 0 and head[4:8] != b"ftyp"):
            return b""
        if head[4:8] == b"moov":
            stream.seek(position)
            return stream.read(min(size, _MOST_INDEX_BYTES) if size else _MOST_INDEX_BYTES)
        if size < 8:
            return b""
        position += size
    return b""
