"""Points of one image placed in another by their patches, each warped as the geometry foretells."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from epipole import _parallel
from epipole._declared import checked
from epipole.errors import ConfigError, ShapeError
from epipole.features import _patch_kernels as kernels

SIMILAR = 0.5
"""Correlation in a halved image at which the place there is a better guess than the one before."""
COARSE_HALF_PX = 6
"""Larger patches of a halved image reach over several surfaces."""
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
    """Place points by least squares of their patches, free of the drift of following from image to image.

    Args:
        first: grey image that the patches are of.
        second: image to find them in.
        pixels: where the points are in the first.
        warps: d(pixel in second) / d(pixel in first) around each point.
        guess: where they are thought to be in the second, to a pixel or three.
        half_px: the patches are of 2 half_px + 1 pixels a side.

    Returns:
        Pixels in the second image, and the correlation of the patches there: 1 for the same look, NaN where a patch is
        flat or leaves its image.

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


@checked
def find_patches(
    first: UInt8[np.ndarray, "h w"],
    second: UInt8[np.ndarray, "h2 w2"],
    pixels: Float64[np.ndarray, "n 2"],
    warps: Float64[np.ndarray, "n 2 2"],
    guess: Float64[np.ndarray, "n 2"],
    levels: int = 3,
    half_px: int = 6,
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """The same from guesses that are further off: from halved images to the images themselves.

    Each level doubles the distance, some 2 pixels for one, from which a patch is found.

    Args:
        first: grey image that the patches are of.
        second: image to find them in.
        pixels: where the points are in the first.
        warps: d(pixel in second) / d(pixel in first) around each point.
        guess: where they are thought to be in the second.
        levels: times that the images are halved, and one more.
        half_px: the patches are of 2 half_px + 1 pixels a side, in halved images of 13 at most.

    Returns:
        Pixels in the second image, and the correlation of the patches there, as `align_patches`.

    Raises:
        ShapeError: the arrays do not fit.
        ConfigError: levels is not from 1 to 8, half_px not from 2 to 20.
    """
    if not 1 <= levels <= 8:
        raise ConfigError(f"levels must be from 1 to 8, got {levels}")
    if not (first.size and second.size):
        raise ShapeError(f"the images have no pixels: {first.shape} and {second.shape}")
    images = [(first, second)]
    for _ in range(levels - 1):
        images.append((cv2.pyrDown(images[-1][0]), cv2.pyrDown(images[-1][1])))
    at = guess
    for level in range(levels - 1, 0, -1):
        unit = 2.0**level
        found, score = align_patches(
            *images[level], pixels / unit, warps, at / unit, min(half_px, COARSE_HALF_PX)
        )
        at = np.where((score > SIMILAR)[:, None], unit * found, at)
    return align_patches(first, second, pixels, warps, at, half_px)


@checked
def find_along_rows(
    first: UInt8[np.ndarray, "h w"],
    second: UInt8[np.ndarray, "h w"],
    pixels: Float64[np.ndarray, "n 2"],
    max_shift: int,
    half_px: int = 5,
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Whole shifts to the left after which patches look most alike (zero-mean normalised correlation), each tried in turn.

    Args:
        first: grey image, rectified.
        second: its partner.
        pixels: points in the first.
        max_shift: the largest, in pixels.
        half_px: the patches are of 2 half_px + 1 pixels a side.

    Returns:
        Shifts; correlations; the largest correlation two or more pixels from there. NaN where a patch is flat, or leaves
        the image.

    Raises:
        ShapeError: the arrays do not fit.
        ConfigError: max_shift is negative, or half_px not from 2 to 20.
    """
    if max_shift < 0 or not 2 <= half_px <= 20:
        raise ConfigError(
            f"max_shift must not be negative and half_px from 2 to 20, got {max_shift} and {half_px}"
        )
    max_shift = min(max_shift, first.shape[1])  # farther left there is no image
    out = np.full((len(pixels), 3), np.nan)
    at = np.where(np.isfinite(pixels).all(axis=1, keepdims=True), pixels, -1.0)
    _parallel.map_chunks(
        lambda a, b, _: kernels.find_along_rows(first, second, at, max_shift, half_px, a, b, out),
        len(at),
        max(1, min(4, len(at) // FEWEST_OF_CHUNK)),
    )
    return out[:, 0], out[:, 1], out[:, 2]
