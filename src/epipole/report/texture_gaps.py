"""Filling of the unused parts of textures, so that filtering at a distance does not mix them into the surface."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

MARGIN_PX = 2
"""Pixels around a triangle that stay unchanged."""
DARKEST = 24
"""Unused pixels are filled only if all channels are below this value: gaps are black, and other content is left alone."""
COARSE = 4
"""Factor of the resolution at which gaps are filled."""


def without_gaps(
    texture: UInt8[np.ndarray, "h w 3"], uv: Float64[np.ndarray, "m 3 2"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Fill black pixels that no triangle uses with the colors around them.

    Args:
        texture: the texture.
        uv: texture coordinates of the triangles; if some are outside 0 to 1, the texture repeats and stays unchanged.
    """
    if not len(uv) or uv.min() < 0.0 or uv.max() > 1.0:
        return texture
    unused = ~_is_used(texture.shape[:2], uv) & (texture.max(axis=2) < DARKEST)
    if not unused.any():
        return texture
    height, width = unused.shape
    coarse = max(1, width // COARSE), max(1, height // COARSE)
    known = cv2.resize((~unused).astype(np.float32), coarse, interpolation=cv2.INTER_AREA)
    seen = np.where(unused[..., None], np.uint8(0), texture)
    colors = cv2.resize(seen, coarse, interpolation=cv2.INTER_AREA).astype(np.float32)
    spread = _spread(colors / np.maximum(known, 1e-3)[..., None], known > 0.05)
    full = cv2.resize(np.clip(spread, 0, 255).astype(np.uint8), (width, height))
    return np.where(unused[..., None], full, texture)


def _is_used(shape: tuple[int, int], uv: np.ndarray) -> np.ndarray:
    """Pixels inside the bounding rectangle of a triangle, with a margin."""
    size = np.array(shape[::-1])
    low = np.clip(np.floor(uv.min(axis=1) * size).astype(np.int64) - MARGIN_PX, 0, size)
    high = np.clip(np.ceil(uv.max(axis=1) * size).astype(np.int64) + MARGIN_PX, 0, size)
    count = np.zeros((shape[0] + 1, shape[1] + 1), np.int32)
    for x, y, sign in ((low, low, 1), (high, low, -1), (low, high, -1), (high, high, 1)):
        np.add.at(count, (y[:, 1], x[:, 0]), sign)
    np.cumsum(count, axis=0, out=count)
    np.cumsum(count, axis=1, out=count)
    return np.asarray(count[:-1, :-1] > 0)


def _spread(colors: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Colors where known, elsewhere the average of known colors nearby, from ever coarser images."""
    height, width = known.shape
    if known.all() or max(height, width) == 1:
        return colors
    half = max(1, width // 2), max(1, height // 2)
    weight = cv2.resize(known.astype(np.float32), half, interpolation=cv2.INTER_AREA)
    total = cv2.resize(colors * known[..., None], half, interpolation=cv2.INTER_AREA)
    coarse = _spread(total / np.maximum(weight, 1e-6)[..., None], weight > 0)
    return np.where(known[..., None], colors, cv2.resize(coarse, (width, height)))
