"""Subpixel matching of patches between images, each warped as the geometry predicts."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8

from epipole import _parallel
from epipole._checks import checked
from epipole.errors import ConfigError, ShapeError
from epipole.features import _patch_kernels as kernels

SIMILAR = 0.5
"""Correlation in a downscaled image above which its position replaces the guess."""
COARSE_HALF_PX = 6
"""Half width at coarse levels, where larger patches would span several surfaces."""
FEWEST_OF_CHUNK = 50
"""Smallest chunk for a thread: fewer patches cost less than the hand-over."""


@checked
def align_patches(
    first: UInt8[np.ndarray, "h w"],
    second: UInt8[np.ndarray, "h2 w2"],
    pixels: Float64[np.ndarray, "n 2"],
    warps: Float64[np.ndarray, "n 2 c"],
    guess: Float64[np.ndarray, "n 2"],
    half_px: int = 6,
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Locate points by least squares over their patches, without the drift of frame-to-frame tracking.

    Args:
        first: gray image with the patches.
        second: image to search.
        pixels: positions in the first image.
        warps: (n, 2, 2) d(pixel in second) / d(pixel in first) around each point; or (n, 2, 5), with its second derivatives by
            uu, uv and vv, too. Without these, a bent patch is found off its center: by 0.1 px between views 60 degrees apart.
        guess: predicted positions in the second image, within about three pixels.
        half_px: patches have 2 half_px + 1 pixels per side.

    Returns:
        Pixels in the second image, and the correlation of the patches there: 1 for identical appearance, NaN if a patch is
        flat or leaves its image.

    Raises:
        ShapeError: array sizes do not match.
        ConfigError: half_px is not from 2 to 20.
    """
    return align_patches_of_images(
        [first], np.zeros(len(pixels), np.int64), second, pixels, warps, guess, half_px
    )


@checked
def align_patches_of_images(
    images: Sequence[UInt8[np.ndarray, "_ _"]],
    image: Int64[np.ndarray, " n"],
    second: UInt8[np.ndarray, "h2 w2"],
    pixels: Float64[np.ndarray, "n 2"],
    warps: Float64[np.ndarray, "n 2 c"],
    guess: Float64[np.ndarray, "n 2"],
    half_px: int = 6,
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Like `align_patches`, for patches of several images in one call.

    Args:
        images: gray images with the patches.
        image: index of each patch's image.
        second: image to search.
        pixels: as in `align_patches`, each in its own image.
        warps: as in `align_patches`.
        guess: as in `align_patches`.
        half_px: as in `align_patches`.

    Returns:
        As `align_patches`.

    Raises:
        ShapeError: array sizes do not match, or an index has no image.
        ConfigError: half_px is out of range.
    """
    if not 2 <= half_px <= 20:
        raise ConfigError(f"half_px must be from 2 to 20, got {half_px}")
    if len(image) and not 0 <= image.min() <= image.max() < len(images):
        raise ShapeError(f"image has indices from {image.min()} to {image.max()}, for {len(images)} images")
    if warps.shape[2] not in (2, 5):
        raise ShapeError(f"warps must have the shape (n, 2, 2) or (n, 2, 5), got {warps.shape}")
    usable = (
        np.isfinite(pixels).all(axis=1) & np.isfinite(guess).all(axis=1) & np.isfinite(warps).all(axis=(1, 2))
    )
    order = np.argsort(image, kind="stable")
    at, bent = np.where(usable[:, None], pixels, -1.0)[order], np.zeros((len(pixels), 2, 5))
    bent[..., : warps.shape[2]] = warps[order]
    found, score = guess[order], np.full(len(pixels), np.nan)
    ends = np.searchsorted(image[order], np.arange(len(images) + 1))

    def align(start: int, stop: int, _chunk: int) -> None:
        for k in range(image[order[start]], image[order[stop - 1]] + 1):
            a, b = max(start, int(ends[k])), min(stop, int(ends[k + 1]))
            if a < b:
                kernels.align_patches(images[k], second, at, bent, half_px, a, b, found, score)

    _parallel.map_chunks(align, len(at), max(1, min(4, len(at) // FEWEST_OF_CHUNK)))
    back = np.argsort(order)
    return found[back], score[back]


@checked
def find_patches(
    first: UInt8[np.ndarray, "h w"],
    second: UInt8[np.ndarray, "h2 w2"],
    pixels: Float64[np.ndarray, "n 2"],
    warps: Float64[np.ndarray, "n 2 c"],
    guess: Float64[np.ndarray, "n 2"],
    levels: int = 3,
    half_px: int = 6,
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Like `align_patches`, but coarse to fine, from worse guesses.

    Each level doubles the distance from which a patch is found, about 2 pixels for a single level.

    Args:
        first: gray image with the patches.
        second: image to search.
        pixels: positions in the first image.
        warps: as in `align_patches`.
        guess: predicted positions in the second image.
        levels: number of pyramid levels, each half the size of the one before.
        half_px: patches have 2 half_px + 1 pixels per side, at most 13 in downscaled images.

    Returns:
        Pixels in the second image, and the correlation of the patches there, as in `align_patches`.

    Raises:
        ShapeError: array sizes do not match, or an image is empty.
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
            *images[level], pixels / unit, _scaled(warps, unit), at / unit, min(half_px, COARSE_HALF_PX)
        )
        at = np.where((score > SIMILAR)[:, None], unit * found, at)
    return align_patches(first, second, pixels, warps, at, half_px)


def _scaled(warps: np.ndarray, unit: float) -> np.ndarray:
    """The warps in images that are smaller by a factor, where second derivatives per pixel are larger by it."""
    return np.concatenate([warps[..., :2], unit * warps[..., 2:]], axis=2)


@checked
def find_along_rows(
    first: UInt8[np.ndarray, "h w"],
    second: UInt8[np.ndarray, "h w"],
    pixels: Float64[np.ndarray, "n 2"],
    max_shift: int,
    half_px: int = 5,
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Integer shifts to the left with the highest patch correlation (zero-mean normalized), by exhaustive search.

    Args:
        first: gray image, rectified.
        second: its rectified partner.
        pixels: points in the first image.
        max_shift: largest shift, in pixels.
        half_px: patches have 2 half_px + 1 pixels per side.

    Returns:
        Shifts; correlations; the largest correlation two or more pixels away. NaN if a patch is flat or leaves the image.

    Raises:
        ShapeError: array sizes do not match.
        ConfigError: max_shift is negative, or half_px not from 2 to 20.
    """
    if max_shift < 0 or not 2 <= half_px <= 20:
        raise ConfigError(
            f"max_shift must not be negative and half_px must be from 2 to 20, got {max_shift} and {half_px}"
        )
    max_shift = min(max_shift, first.shape[1])  # larger shifts leave the image
    out = np.full((len(pixels), 3), np.nan)
    at = np.where(np.isfinite(pixels).all(axis=1, keepdims=True), pixels, -1.0)
    _parallel.map_chunks(
        lambda a, b, _: kernels.find_along_rows(first, second, at, max_shift, half_px, a, b, out),
        len(at),
        max(1, min(4, len(at) // FEWEST_OF_CHUNK)),
    )
    return out[:, 0], out[:, 1], out[:, 2]
