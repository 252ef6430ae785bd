"""Points of one picture placed in another by their patches, each warped as the geometry foretells."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, UInt8

from epipole import _parallel
from epipole._declared import checked
from epipole.errors import ConfigError
from epipole.features import _patch_kernels as kernels

FEWEST_OF_CHUNK = 50
"""Fewer patches take less time than handing them to another thread."""


@checked
def align_patches(
    first: UInt8[np.ndarray, "h w"],
    second: UInt8[np.ndarray, "h2 w2"],
    pixels: Float64[np.ndarray, "n 2"],
    warps: Float64[np.ndarray, "n 2 2"],
    guess: Float64[np.ndarray, "n 2"],
    half_px: int = 6,
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Place points by least squares of their patches, free of the drift of following from picture to picture.

    Args:
        first: grey picture that the patches are of.
        second: picture to find them in.
        pixels: where the points are in the first.
        warps: d(pixel in second) / d(pixel in first) around each point.
        guess: where they are thought to be in the second, to a pixel or three.
        half_px: the patches are of 2 half_px + 1 pixels a side.

    Returns:
        Pixels in the second picture, and the correlation of the patches there: 1 for the same look, NaN where a patch is
        flat or leaves its picture.

    Raises:
        ShapeError: the arrays do not fit.
        ConfigError: half_px is not from 2 to 20.
    """
    if not 2 <= half_px <= 20:
        raise ConfigError(f"half_px must be from 2 to 20, got {half_px}")
    found, score = guess.copy(), np.full(len(pixels), np.nan)
    usable = (
        np.isfinite(pixels).all(axis=1) & np.isfinite(guess).all(axis=1) & np.isfinite(warps).all(axis=(1, 2))
    )
    at = np.where(usable[:, None], pixels, -1.0)
    _parallel.map_chunks(
        lambda a, b, _: kernels.align_patches(first, second, at, warps, half_px, a, b, found, score),
        len(at),
        max(1, min(4, len(at) // FEWEST_OF_CHUNK)),
    )
    return found, score
