"""Images with transparency, and writing of rendered images."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from epipole._checks import check_pixels, checked
from epipole.io._spherical import refuse_panorama
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes
from epipole.io.images.exif import orientation_of
from epipole.io.images.formats import format_of
from epipole.io.images.pixels import (
    as_stored,
    exif_of,
    open_with_pillow,
    refuse_huge,
    rotation,
    stored_pixels,
)

_WITH_ALPHA = ("PNG", "TIFF", "WEBP", "AVIF", "HEIF")


@checked
def read_rgba(path: Path | str, *, orientation: int | None = None) -> UInt8[np.ndarray, "h w 4"] | None:
    """Read an image with transparency as RGBA, not composited; None if it has no alpha.

    Args:
        path: the image.
        orientation: applied instead of the file's EXIF orientation, as in `read_rgb`.

    Raises:
        FileFormatError: the image is damaged or too large, or the file is not an image.
    """
    path = Path(path)
    data = file_bytes(path)
    kind = format_of(path, data[:64])
    if kind not in _WITH_ALPHA:
        return None
    image = open_with_pillow(path, io.BytesIO(data), kind)
    refuse_panorama(path, image)
    if "A" not in image.getbands() and "transparency" not in image.info:
        return None
    refuse_huge(path, image, data)
    stored = orientation_of(exif_of(image)) if kind == "TIFF" else None
    pixels, own = stored_pixels(path, image, data)
    if pixels.ndim != 3 or pixels.shape[2] != 4:
        return None
    return rotation(as_stored(pixels, stored, own, orientation), orientation or own)


@checked
def write_png(path: Path | str, rgb: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write an image as PNG.

    Raises:
        ConfigError: the image has no pixels, or too many.
        WorkspaceError: the file cannot be written.
    """
    check_pixels(rgb.shape[1], rgb.shape[0])
    data = io.BytesIO()
    Image.fromarray(rgb).save(data, "PNG", compress_level=3)
    with atomic_write(Path(path)) as aside:
        aside.write_bytes(data.getvalue())
