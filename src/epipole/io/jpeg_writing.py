"""Rendered photographs as JPEG with the EXIF of a camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from epipole._declared import checked
from epipole.errors import ConfigError
from epipole.io.atomic import atomic_write
from epipole.io.exif import GpsPosition, new_exif

_LONGEST_JPEG_SIDE = 65500


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
    """Write a rendered photograph as JPEG with the EXIF of a camera (35 mm equivalent rounded to mm).

    Raises:
        ConfigError: a number is beyond what EXIF or JPEG hold, or the image has no pixel or more than JPEG takes.
        WorkspaceError: the file cannot be written.
    """
    if not 1 <= quality <= 100:
        raise ConfigError(f"quality must be from 1 to 100, got {quality}")
    if not (rgb.size and max(rgb.shape) <= _LONGEST_JPEG_SIDE):
        raise ConfigError(
            f"a JPEG has sides of 1 to {_LONGEST_JPEG_SIDE} pixels, got {rgb.shape[1]} x {rgb.shape[0]}"
        )
    exif = new_exif(make, model, focal_35mm, gps).tobytes()
    with atomic_write(path) as part:
        Image.fromarray(np.ascontiguousarray(rgb)).save(part, "JPEG", quality=quality, exif=exif)
