"""Interpolation of unknown pixels, which have no standard deviation and are marked by a mask."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from epipole import _parallel
from epipole.errors import ConfigError, ShapeError
from epipole.pipelines.stereo import _filling_kernels as kernels
from epipole.scene import DisparityMap, StereoReason

_ROUNDS = 3
_SHARPNESS = 255.0 / 8.0
_BEHIND = (StereoReason.OCCLUDED, StereoReason.OUT_OF_VIEW)
_GUESS_WEIGHT = 10.0
_LEAST = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class FilledDisparities:
    """Disparities without holes."""

    disparity_px: Float32[np.ndarray, "h w"]
    """Known values are unchanged; all NaN if none is known."""
    filled_mask: Bool[np.ndarray, "h w"]
    """Interpolated pixels."""

    def __repr__(self) -> str:
        height, width = self.filled_mask.shape
        return f"FilledDisparities({width} x {height}, {100 * self.filled_mask.mean():.1f} % filled)"


def fill_disparities(found: DisparityMap, left: Any, strength: float = 10.0) -> FilledDisparities:
    """Fill unknown pixels by weighted least squares guided by the image; occluded pixels get the background.

    A pixel occluded in the right image belongs to the farther of the surfaces beside it (Hirschmueller, PAMI 2008, section 2.5): the
    smaller of the nearest known disparities in its row is used as an observation with a standard deviation of a third of a pixel.
    Elsewhere the surface is smooth except at image edges.

    Args:
        found: the disparities; known pixels are weighted by the inverse of their variance.
        left: (h, w) or (h, w, 3), 8 bits.
        strength: weight of the smoothness term.

    Raises:
        ShapeError: the image does not match the disparities.
        ConfigError: the strength is not positive.
    """
    if not strength > 0:
        raise ConfigError(f"strength must be positive, got {strength}")
    image = np.ascontiguousarray(left)
    if image.dtype != np.uint8 or image.shape[:2] != found.reason.shape:
        raise ShapeError(
            f"left must be an 8-bit image of shape {found.reason.shape}, got {image.shape} of {image.dtype}"
        )
    known = np.isfinite(found.disparity_px)
    if not known.any():
        return FilledDisparities(found.disparity_px.copy(), np.zeros(known.shape, bool))
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    weight = np.where(known, 1.0 / np.maximum(found.sigma_px, 0.05).astype(np.float64) ** 2, 0.0)
    values = np.where(known, found.disparity_px, 0.0).astype(np.float64)
    behind = ~known & np.isin(found.reason, _BEHIND)
    guess = _farther_neighbor(found.disparity_px)
    use = behind & np.isfinite(guess)
    values[use], weight[use] = guess[use], _GUESS_WEIGHT
    weight /= weight.max()
    smooth = _smoothed(weight, weight * values, gray.astype(np.float64), strength)
    out = np.where(known, found.disparity_px, smooth).astype(np.float32)
    return FilledDisparities(out, ~known)


def _smoothed(
    weight: np.ndarray, weighted: np.ndarray, gray: np.ndarray, strength: float
) -> Float32[np.ndarray, "h w"]:
    """Smoothed weighted values over smoothed weights, with decreasing strength (Min et al., TIP 2014, equation 16)."""
    across = np.exp(-np.abs(np.diff(gray, axis=1)) / 255.0 * _SHARPNESS)
    down = np.exp(-np.abs(np.diff(gray, axis=0)) / 255.0 * _SHARPNESS)
    along = [np.pad(across, ((0, 0), (0, 1))), np.ascontiguousarray(np.pad(down, ((0, 1), (0, 0))).T)]
    for round_ in range(_ROUNDS):
        fraction = 1.5 * 4.0 ** (_ROUNDS - round_ - 1) / (4.0**_ROUNDS - 1.0)
        for links in along:
            _smooth_rows(weight, weighted, links, fraction * strength)
            weight, weighted = np.ascontiguousarray(weight.T), np.ascontiguousarray(weighted.T)
    return (weighted / np.maximum(weight, _LEAST)).astype(np.float32)


def _smooth_rows(weight: np.ndarray, weighted: np.ndarray, links: np.ndarray, strength: float) -> None:
    _parallel.map_chunks(
        lambda a, b, _: kernels.smooth_rows(weight, weighted, links, strength, a, b), len(weight)
    )


def _farther_neighbor(disparity: np.ndarray) -> Float32[np.ndarray, "h w"]:
    """The smaller of the nearest known disparities to the left and right in the row; NaN if there is none."""
    width = disparity.shape[1]
    known = np.isfinite(disparity)
    column = np.arange(width)
    last = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    following = np.minimum.accumulate(np.where(known, column, width)[:, ::-1], axis=1)[:, ::-1]
    rows = np.arange(len(disparity))[:, None]
    left = np.where(last >= 0, disparity[rows, np.maximum(last, 0)], np.inf)
    right = np.where(following < width, disparity[rows, np.minimum(following, width - 1)], np.inf)
    smaller = np.minimum(left, right)
    return np.where(np.isfinite(smaller), smaller, np.nan).astype(np.float32)
