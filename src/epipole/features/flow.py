"""Points followed from one image to the next: pyramidal Lucas-Kanade, with OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from epipole._declared import checked
from epipole.config import FlowConfig, options_of
from epipole.errors import ShapeError

LARGEST_GAIN = 1.2
"""Between images as they are; one that is darker by more is first made as bright as the other."""
AROUND_PX = 15
"""Side of the square whose mean tells how bright a point is."""


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
    """Find points of one image in another (Lucas and Kanade 1981; Bouguet 2001), and back again.

    The method takes a point to be as bright in both. Where exposure differs, so that the points are darker in one of the images
    by a sixth or more (median), that one is brightened first.

    Args:
        first: grey image that the points are in.
        second: another of its size.
        pixels: where they are in the first.
        guess: where they are thought to be in the second; None: at the same place.
        config: options.
        and_back: points count as found only if the way back ends where it began.

    Returns:
        Pixels in the second image, and which of them were found.

    Raises:
        ShapeError: the images are smaller than a patch.
    """
    config = options_of(FlowConfig, config)
    if min(first.shape) <= config.window_px:
        raise ShapeError(f"an image of {first.shape[1]} x {first.shape[0]} is too small for the patches")
    if not len(pixels):
        return np.zeros((0, 2)), np.zeros(0, bool)
    height, width = first.shape
    at = np.ascontiguousarray(pixels, np.float32)
    start = at if guess is None else np.ascontiguousarray(guess, np.float32)
    # A guess outside the image, or none at all, is no place to begin at.
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
    """The images, the darker one multiplied if points at these places differ by more than the method bears."""
    one, other = _brightness(first, at), _brightness(second, there)
    gain = float(np.median((other + 1.0) / (one + 1.0)))
    if gain > LARGEST_GAIN:
        return cv2.convertScaleAbs(first, alpha=gain), second
    if gain < 1.0 / LARGEST_GAIN:
        return first, cv2.convertScaleAbs(second, alpha=1.0 / gain)
    return first, second


def _brightness(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n,) mean grey around pixels; what lies outside counts as the rim."""
    last = np.array(image.shape[::-1]) - 1
    column, row = np.rint(np.clip(np.nan_to_num(pixels), 0, last)).astype(np.int64).T
    return cv2.blur(image, (AROUND_PX, AROUND_PX))[row, column].astype(np.float64)
