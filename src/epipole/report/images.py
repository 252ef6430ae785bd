"""Images inside a page: data URIs, and thumbnails with the features that observe points."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, UnidentifiedImageError

from epipole.image import color_map, color_range, downscaled
from epipole.image.encoding import encoded_image
from epipole.report.markup import data_uri

MAX_FEATURES = 400
"""Largest number of features shown on one thumbnail."""
_SHOWN_PX = 1000  # longest side of the images in the page
_JPEG_PX, _JPEG_QUALITY = 640, 85
_SMALL_BYTES = 1 << 15
"""Longest side of photographs, shown three side by side, and their JPEG quality; PNGs up to this size (bytes) stay
lossless."""


def png_uri(rgb: UInt8[np.ndarray, "h w 3"]) -> str:
    """The image, downscaled, as a data URI."""
    small = downscaled(rgb, _SHOWN_PX)
    return data_uri(encoded_image(".png", small[..., ::-1]), "image/png")


def jpeg_uri(rgb: UInt8[np.ndarray, "h w 3"]) -> str:
    """A photograph or a render, downscaled, as a data URI: a JPEG, a tenth the size, unless its PNG is small."""
    small = downscaled(rgb, _JPEG_PX)
    exact = encoded_image(".png", small[..., ::-1])
    if len(exact) <= _SMALL_BYTES:
        return data_uri(exact, "image/png")
    return data_uri(encoded_image(".jpg", small[..., ::-1], _JPEG_QUALITY), "image/jpeg")


def color_map_uri(values: Float[np.ndarray, "h w"]) -> str:
    """Numbers as color-mapped image, as a data URI."""
    return png_uri(color_map(values))


def color_range_text(values: Float[np.ndarray, "h w"]) -> str:
    """Text for the ends of the color map."""
    low, high = color_range(values)
    return f"{low:.3g} (blue) to {high:.3g} (red)"


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A small image with dots on it."""

    width: int
    height: int
    uri: str
    dots: str
    """A path of zero-length strokes, which round caps turn into discs; much shorter than circle elements."""


def thumbnail_of(jpeg: bytes, fractions: Float[np.ndarray, "k 2"]) -> Thumbnail | None:
    """The image with dots at these fractions of width and height; None if it is not a JPEG."""
    size = _jpeg_size(jpeg)
    if size is None:
        return None
    inside = fractions[((fractions >= 0) & (fractions <= 1)).all(axis=1)]
    chosen = inside[np.linspace(0, len(inside) - 1, min(len(inside), MAX_FEATURES)).astype(int)]
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in chosen * size)
    return Thumbnail(*size, data_uri(jpeg, "image/jpeg"), dots)


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    try:
        with Image.open(io.BytesIO(data)) as image:
            return image.size if image.format == "JPEG" else None
    except (UnidentifiedImageError, OSError):
        return None
