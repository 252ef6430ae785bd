"""Spherical images and cameras, which are refused: no camera model here describes them."""

from __future__ import annotations

import re
from pathlib import Path

from PIL.ImageFile import ImageFile
from PIL.TiffImagePlugin import TiffImageFile

from epipole.errors import FileFormatError

SPHERICAL_REFUSAL = (
    "spherical (equirectangular) images are not supported; render perspective views of them first"
)

_WORDS = ("equirect", "spherical", "latlong", "lonlat", "latlon", "panoram", "omnidirectionalstereo", "vr180")
_TIFF_XMP = 700
_PROJECTION = re.compile(rb"ProjectionType\s*(?:=\s*[\"']|>)\s*([A-Za-z]{1,40})")
_PLANE = (b"perspective", b"rectilinear")


def is_spherical_word(word: str) -> bool:
    """Whether the name of a camera model or a key is that of a spherical image."""
    return any(known in word.lower() for known in _WORDS)


def refuse_panorama(path: Path, image: ImageFile) -> None:
    """Refuse an image whose XMP block names another projection than that of a plane (Google's GPano:ProjectionType).

    Raises:
        FileFormatError: it is a panorama.
    """
    xmp = image.tag_v2.get(_TIFF_XMP) if isinstance(image, TiffImageFile) else image.info.get("xmp")
    data = xmp.encode(errors="replace") if isinstance(xmp, str) else xmp
    found = _PROJECTION.search(data) if isinstance(data, bytes) else None
    if found is not None and found[1].lower() not in _PLANE:
        projection = found[1].decode()
        raise FileFormatError(path, f"its metadata say ProjectionType {projection}: {SPHERICAL_REFUSAL}")
