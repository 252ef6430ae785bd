"""Point tracking from one image to the next: pyramidal Lucas-Kanade, with OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from epipole._checks import checked
from epipole.config import FlowConfig, options_of
from epipole.errors import ShapeError

LARGEST_GAIN = 1.2
"""Largest brightness ratio between images without correction; above it, the darker image is brightened first."""
AROUND_PX = 15
"""Side of the square over which the brightness of a point is averaged."""


@checked
def track_points(
    first: UInt8[np.ndarray, "h w"],
    second: UInt8[np.ndarray, "h w"],
    pixels: Float64[np.ndarray, "n 2"],
    guess: Float64[np.ndarray, "n 2"] | None = None,
    config: FlowConfig | None = None,
    *,
    and_back: bool = True,
) -> tuple[Float64[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Track points from one image to another and back (Lucas and Kanade 1981; Bouguet 2001).

    The method assumes constant brightness. If the points are darker in one of the images by a sixth or more (median),
    that image is brightened first.

    Args:
        first: gray image with the points.
        second: gray image of the same size.
        pixels: positions in the first image.
        guess: predicted positions in the second image; None: unchanged.
        config: options.
        and_back: reject points whose backward track does not return to the start.

    Returns:
        Pixels in the second image, and a mask of the points that were tracked.

    Raises:
        ShapeError: the images are smaller than the tracking window.
    """
    config = options_of(FlowConfig, config)
    if min(first.shape) <= config.window_px:
        raise ShapeError(
            f"image size {first.shape[1]} x {first.shape[0]} is too small for the tracking window"
        )
    if not len(pixels):
        return np.zeros((0, 2)), np.zeros(0, bool)
    height, width = first.shape
    at = np.ascontiguousarray(pixels, np.float32)
    start = at if guess is None else np.ascontiguousarray(guess, np.float32)
    # Ignore guesses that are missing or outside the image.
    usable = np.asarray(np.isfinite(start) & (start >= 0) & (start < (width, height))).all(
        axis=1, keepdims=True
    )
    start = np.where(usable, start, at)
    first, second = _equally_bright(first, second, at, start)
    side = (config.window_px, config.window_px)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        first, second, at, start.copy(), winSize=side, maxLevel=config.levels - 1, criteria=stop, flags=flags,
        minEigThreshold=config.min_eigenvalue,
    )  # fmt: skip
    inside = (there >= 0).all(axis=1) & (there <= (width - 1, height - 1)).all(axis=1)
    mask = (found[:, 0] == 1) & inside
    if and_back:
        back, returned, _ = cv2.calcOpticalFlowPyrLK(
            second, first, there, at.copy(), winSize=side, maxLevel=min(1, config.levels - 1), criteria=stop, flags=flags,
            minEigThreshold=config.min_eigenvalue,
        )  # fmt: skip
        mask &= (returned[:, 0] == 1) & (np.linalg.norm(back - at, axis=1) <= config.max_return_px)
    return there.astype(np.float64), mask


def _equally_bright(
    first: np.ndarray, second: np.ndarray, at: np.ndarray, there: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The images, the darker one brightened if the gain at these points is too large for the method."""
    one, other = _brightness(first, at), _brightness(second, there)
    gain = float(np.median((other + 1.0) / (one + 1.0)))
    if gain > LARGEST_GAIN:
        return cv2.convertScaleAbs(first, alpha=gain), second
    if gain < 1.0 / LARGEST_GAIN:
        return first, cv2.convertScaleAbs(second, alpha=1.0 / gain)
    return first, second


def _brightness(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n,) mean gray value around pixels; the border is replicated."""
    last = np.array(image.shape[::-1]) - 1
    column, row = np.rint(np.clip(np.nan_to_num(pixels), 0, last)).astype(np.int64).T
    return cv2.blur(image, (AROUND_PX, AROUND_PX))[row, column].astype(np.float64)
