"""Pictures with transparency, and pictures that are drawn."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from epipole.errors import FileFormatError
from epipole.io._photograph_pixels import (
    MAX_LOSSLESS_PX,
    PILLOW_ERRORS,
    as_stored,
    exif_of,
    format_of,
    open_with_pillow,
    turn,
)
from epipole.io.atomic import atomic_write
from epipole.io.exif import orientation_of
from epipole.io.files import file_bytes


def read_rgba(path: Path | str, *, orientation: int | None = None) -> UInt8[np.ndarray, "h w 4"] | None:
    """Read a PNG, TIFF or WebP with transparency: colours not composited, and alpha; None where there is none.

    Args:
        path: the image.
        orientation: applied in place of the file's EXIF orientation, as in `read_rgb`.

    Raises:
        FileFormatError: it is damaged, too large or not a picture.
    """
    path = Path(path)
    data = file_bytes(path)
    kind = format_of(path, data[:32])
    if kind not in ("PNG", "TIFF", "WEBP"):
        return None
    with open_with_pillow(path, io.BytesIO(data), kind) as image:
        if "A" not in image.getbands():
            return None
        if image.width * image.height > MAX_LOSSLESS_PX:
            raise FileFormatError(path, "the picture is too large")
        try:
            stored = orientation_of(exif_of(image)) if kind == "TIFF" else None
            image.load()
            own = orientation_of(exif_of(image))
            pixels = as_stored(np.asarray(image.convert("RGBA")), stored, own, orientation)
            return turn(pixels, orientation or own)
        except PILLOW_ERRORS as error:
            raise FileFormatError(path, f"the {kind} picture is damaged ({error})") from error


def write_png(path: Path | str, rgb: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a picture as PNG.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    data = io.BytesIO()
    Image.fromarray(rgb).save(data, "PNG", compress_level=3)
    with atomic_write(Path(path)) as aside:
        aside.write_bytes(data.getvalue())
