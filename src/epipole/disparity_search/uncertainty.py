"""Standard deviations of disparities.

Six cues per pixel: steepness of the sums at their minimum, margin to the second best, difference from the other image's disparity,
change by the median filter, roughness of the neighborhood, and difference between the winners of the two sweeps. Their logarithms
and squares form a score; the table from scores to standard deviations was fitted on rendered rooms such that 68 % of the errors are
within one standard deviation (`python -m benchmarks.stereo_sigma --fit`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt16

from epipole import _parallel
from epipole._checks import Declared, checked
from epipole.errors import ShapeError

NUM_CUES = 6
_ROWS = 64  # at a time: the cues take 24 bytes per pixel
_MOST_APART_PX = np.float32(
    1e4
)  # keeps the score finite for pixels without a match in the other image, whose difference is infinite
_TABLE = 4096  # entries, evenly spaced in the score
WEIGHTS = np.array(
    [-0.2448, 0.0088, 0.201, 0.0679, 0.096, -0.0324, 0.0281, -0.0087, -0.0445, 0.0119, 0.0412, 0.0435, -0.162]
)
"""Weights of the score: constant, cues, squares of the cues."""
SCORES = np.array(
    [
        -2.2693,
        -2.1727,
        -2.0993,
        -2.0317,
        -1.9623,
        -1.8862,
        -1.8023,
        -1.7123,
        -1.6167,
        -1.5144,
        -1.4039,
        -1.2811,
        -1.1431,
        -0.9799,
        -0.7734,
        -0.4619,
    ]
)
LOG_SIGMAS = np.array(
    [
        -1.9387,
        -1.9387,
        -1.9387,
        -1.9387,
        -1.8705,
        -1.7392,
        -1.5837,
        -1.4387,
        -1.2901,
        -1.1382,
        -1.0011,
        -0.8463,
        -0.689,
        -0.5234,
        -0.345,
        0.0137,
    ]
)
"""Natural logarithm of the standard deviation in pixels at each score, linearly interpolated."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchEvidence(Declared):
    """Cues for the uncertainty of each disparity."""

    steepness: Float32[np.ndarray, "h w"]
    """Slope of the sums at their minimum."""
    margin: Float32[np.ndarray, "h w"]
    """Second lowest sum, not adjacent to the lowest, minus the lowest."""
    left_right_px: Float32[np.ndarray, "h w"]
    """Difference from the other image's disparity."""
    smoothing_px: Float32[np.ndarray, "h w"]
    """Change by the median filter."""
    spread: UInt16[np.ndarray, "h w"]
    """Difference between the winners of the downward and the upward sweep."""
    roughness_px: Float32[np.ndarray, "h w"]
    """Local variation of the disparities."""


@checked
def cues(evidence: MatchEvidence, start: int = 0, stop: int | None = None) -> Float32[np.ndarray, "cues h w"]:
    """Logarithms of the cues of rows start..stop; small added constants limit their range."""
    rows = slice(start, stop)
    parts = (
        evidence.steepness[rows] + np.float32(4.0),
        evidence.margin[rows] + np.float32(8.0),
        np.minimum(evidence.left_right_px[rows], _MOST_APART_PX) + np.float32(0.1),
        evidence.smoothing_px[rows] + np.float32(0.1),
        evidence.spread[rows].astype(np.float32) + np.float32(1.0),
        evidence.roughness_px[rows] + np.float32(0.05),
    )
    out = np.empty((NUM_CUES, *parts[0].shape), np.float32)
    for cue, part in zip(out, parts):
        np.log(part, out=cue)
    return out


@checked
def roughness(disparity_px: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Mean absolute deviation, over 5 x 5 pixels, of disparities from their 5 x 5 means."""
    if disparity_px.size == 0:
        raise ShapeError(f"disparity_px is empty: {disparity_px.shape}")
    return np.asarray(cv2.blur(np.abs(disparity_px - cv2.blur(disparity_px, (5, 5))), (5, 5)))


@checked
def score(of: Float32[np.ndarray, "cues h w"]) -> Float32[np.ndarray, "h w"]:
    """Weighted sum of the cues and their squares; larger is worse."""
    weights = WEIGHTS.astype(np.float32)
    out = np.full(of.shape[1:], weights[0])
    for cue, first, second in zip(of, weights[1 : 1 + NUM_CUES], weights[1 + NUM_CUES :]):
        out += cue * (first + second * cue)
    return out


@checked
def disparity_sigma(evidence: MatchEvidence) -> Float32[np.ndarray, "h w"]:
    """Standard deviation of each disparity, in pixels."""
    out = np.empty(evidence.steepness.shape, np.float32)
    low, high = np.float32(SCORES[0]), np.float32(SCORES[-1])
    table = np.exp(np.interp(np.linspace(low, high, _TABLE), SCORES, LOG_SIGMAS)).astype(np.float32)
    scale = np.float32((_TABLE - 1) / (high - low))

    def fill(start: int, stop: int, _: int) -> None:
        position = score(cues(evidence, start, stop))
        position -= low
        position *= scale
        np.clip(position, np.float32(0.0), np.float32(_TABLE - 1), out=position)
        table.take(position.astype(np.int32), out=out[start:stop], mode="clip")

    _parallel.map_chunks(fill, len(out), -(-len(out) // _ROWS))
    return out
