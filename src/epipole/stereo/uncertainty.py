"""How far a disparity may be wrong.

Six things are seen at every pixel: how steep the sums rise from their minimum, by how much the second best loses, how well the
other picture's disparity agrees, what the median filter changed, how much the neighbours differ, and how far apart the paths from above and from below
find it. Their logarithms and squares make a score; the score's table of standard deviations was fitted so that 68 % of
the errors lie within, on rendered rooms alone (`python -m benchmarks.stereo_sigma --fit`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt16

from epipole import _parallel

NUM_CUES = 6
_ROWS = 64  # at a time: the cues take 48 bytes a pixel
WEIGHTS = np.array(
    [-0.2448, 0.0088, 0.201, 0.0679, 0.096, -0.0324, 0.0281, -0.0087, -0.0445, 0.0119, 0.0412, 0.0435, -0.162]
)
"""Of the score: constant, cues, squares of the cues."""
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
"""Natural logarithm of the standard deviation in pixels at each score; in between they are interpolated."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchEvidence:
    """What matching knows of each pixel beside its disparity."""

    steepness: Float32[np.ndarray, "h w"]
    """Of the sums at their minimum."""
    margin: Float32[np.ndarray, "h w"]
    """By how much the lowest sum beats the next that is not beside it."""
    left_right_px: Float32[np.ndarray, "h w"]
    """Difference from the other picture's disparity."""
    smoothing_px: Float32[np.ndarray, "h w"]
    """What the median filter changed."""
    spread: UInt16[np.ndarray, "h w"]
    """How far apart the winners of the downward and the upward sweep lie."""
    roughness_px: Float32[np.ndarray, "h w"]
    """How far its neighbours' disparities differ from each other."""


def cues(evidence: MatchEvidence, start: int = 0, stop: int | None = None) -> Float64[np.ndarray, "h w cues"]:
    """Of rows start..stop: logarithms of what is seen, the small constants being where it no longer says anything."""
    rows = slice(start, stop)
    return np.stack(
        [
            np.log(evidence.steepness[rows] + 4.0),
            np.log(evidence.margin[rows] + 8.0),
            np.log(evidence.left_right_px[rows] + 0.1),
            np.log(evidence.smoothing_px[rows] + 0.1),
            np.log1p(evidence.spread[rows].astype(np.float32)),
            np.log(evidence.roughness_px[rows] + 0.05),
        ],
        axis=-1,
    ).astype(np.float64)


def roughness(disparity_px: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """How far the disparities about a pixel differ from their means over 5 x 5."""
    return np.asarray(cv2.blur(np.abs(disparity_px - cv2.blur(disparity_px, (5, 5))), (5, 5)))


def score(of: Float64[np.ndarray, "... cues"]) -> Float64[np.ndarray, ...]:
    """The cues' weighted sum with their squares; larger is worse."""
    return WEIGHTS[0] + of @ WEIGHTS[1 : 1 + NUM_CUES] + (of * of) @ WEIGHTS[1 + NUM_CUES :]


def disparity_sigma(evidence: MatchEvidence) -> Float32[np.ndarray, "h w"]:
    """Standard deviation of each disparity, in pixels."""
    out = np.empty(evidence.steepness.shape, np.float32)

    def fill(start: int, stop: int, _: int) -> None:
        scores = score(cues(evidence, start, stop))
        out[start:stop] = np.exp(np.interp(scores, SCORES, LOG_SIGMAS))

    _parallel.map_chunks(fill, len(out), -(-len(out) // _ROWS))
    return out
