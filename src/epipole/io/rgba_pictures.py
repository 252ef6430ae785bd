"""Pictures with transparency, and pictures that are drawn."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from epipole._checks import check_pixels
from epipole._declared import checked
from epipole.errors import FileFormatError
from epipole.io._photograph_pixels import MAX_LOSSLESS_PX, PILLOW_ERRORS, format_of, open_with_pillow
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes


@checked
def read_rgba(path: Path | str) -> UInt8[np.ndarray, "h w 4"] | None:
    """Read a PNG, TIFF or WebP with transparency: colours as they are stored, and alpha; None where there is none.

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
            return np.asarray(image.convert("RGBA")).copy()
        except PILLOW_ERRORS as error:
            raise FileFormatError(path, f"the {kind} picture is damaged ({error})") from error


@checked
def write_png(path: Path | str, rgb: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a picture as PNG.

    Raises:
        ConfigError: the image has no pixel, or too many.
        WorkspaceError: the file cannot be written.
    """
    check_pixels(rgb.shape[1], rgb.shape[0])
    data = io.BytesIO()
    Image.fromarray(rgb).save(data, "PNG", compress_level=3)
    with atomic_write(Path(path)) as aside:
        aside.write_bytes(data.getvalue())
