"""Keypoints and descriptors from the maps of ALIKED (Zhao, Wu, Chen, Chen, Xu and Li, IEEE TIM 2023)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

_STRIDE_PX = 32
"""The network takes images whose sides are multiples of it."""
_RADIUS_PX = 2
"""Keypoints are farther than this apart and from the border; ALIKED's nms_radius."""
_MIN_SCORE = 0.2
"""ALIKED's detection_threshold."""
_TEMPERATURE = 0.1
"""Of the softmax of scores whose mean position is the keypoint; ALIKED's."""
_SUPPRESSIONS = 2
"""Further rounds of non-maximum suppression, for maxima that were beside one that is itself beside a higher one."""


def detect_aliked(
    dense: Any, head: Any, image: UInt8[np.ndarray, "h w *channels"], max_num: int, max_size_px: int
) -> tuple[Float32[np.ndarray, "n 2"], Float32[np.ndarray, " n"], Float32[np.ndarray, "n 128"]]:
    """Pixels, scores and descriptors of the features with the highest scores; see `LearnedFeatures.detect`.

    Args:
        dense: the network from an image to feature map and score map.
        head: the network from feature map and keypoints to descriptors.
        image: gray or RGB.
        max_num: maximum number of features.
        max_size_px: images are downscaled to this longest side.
    """
    height, width = image.shape[:2]
    factor = min(1.0, max_size_px / max(height, width))
    size = [max(_STRIDE_PX, round(side * factor)) for side in (width, height)]
    resized = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)) if factor < 1.0 else image
    padded, inside = padded_image(resized)
    features, scores = dense.run(None, {"image": padded[None]})
    features, score_map = features[:, :, *inside], np.ascontiguousarray(scores[0, 0][inside])
    peaks = select_peaks(score_map, max_num)
    peak_scores = score_map[peaks[:, 1], peaks[:, 0]]
    keypoints = refine_peaks(score_map, peaks)
    if len(keypoints) == 0:
        return keypoints, peak_scores, np.empty((0, features.shape[1]), np.float32)
    inputs = {"features": np.ascontiguousarray(features), "keypoints": keypoints}
    # Resampling aligns pixel edges, not centers.
    pixels = (keypoints + 0.5) * (np.array([width, height]) / size) - 0.5
    return pixels.astype(np.float32), peak_scores, head.run(None, inputs)[0]


def padded_image(
    image: UInt8[np.ndarray, "h w *channels"],
) -> tuple[Float32[np.ndarray, "3 p q"], tuple[slice, slice]]:
    """RGB from 0 to 1, padded with its border to multiples of 32, and where the image is in it (rows, columns)."""
    rgb = image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)
    sides = rgb.shape[:2]
    missing = [-side % _STRIDE_PX for side in sides]
    before = [(each // 2, each - each // 2) for each in missing]
    padded = np.pad(rgb, (*before, (0, 0)), mode="edge").astype(np.float32) / np.float32(255.0)
    rows, columns = (slice(start, start + side) for (start, _), side in zip(before, sides))
    return np.ascontiguousarray(padded.transpose(2, 0, 1)), (rows, columns)


def select_peaks(scores: Float32[np.ndarray, "h w"], max_num: int) -> Int64[np.ndarray, "n 2"]:
    """Local maxima (x, y) away from the border, highest first; equal scores in reading order."""
    is_peak = is_local_maximum(scores) & (scores > _MIN_SCORE)
    inner = slice(_RADIUS_PX, -_RADIUS_PX)
    y, x = np.nonzero(is_peak[inner, inner])
    found = np.stack([x, y], axis=1) + _RADIUS_PX
    order = np.argsort(-scores[found[:, 1], found[:, 0]], kind="stable")[:max_num]
    return found[order]


def is_local_maximum(scores: Float32[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Non-maximum suppression that lets a maximum suppress its neighbors only if it is not suppressed itself."""
    window = np.ones((2 * _RADIUS_PX + 1, 2 * _RADIUS_PX + 1), np.uint8)
    is_maximum = scores == cv2.dilate(scores, window)
    for _ in range(_SUPPRESSIONS):
        is_suppressed = cv2.dilate(is_maximum.astype(np.uint8), window) > 0
        remaining = np.where(is_suppressed, np.float32(0), scores)
        is_maximum |= (remaining == cv2.dilate(remaining, window)) & ~is_suppressed
    return np.asarray(is_maximum)


def refine_peaks(
    scores: Float32[np.ndarray, "h w"], peaks: Int64[np.ndarray, "n 2"]
) -> Float32[np.ndarray, "n 2"]:
    """Mean position (x, y) of the scores around each peak, weighted by their softmax (ALIKED's soft-argmax)."""
    side = np.arange(-_RADIUS_PX, _RADIUS_PX + 1)
    dy, dx = (each.ravel() for each in np.meshgrid(side, side, indexing="ij"))
    around = scores[peaks[:, 1, None] + dy, peaks[:, 0, None] + dx]
    weight = np.exp((around - around.max(axis=1, keepdims=True)) / np.float32(_TEMPERATURE))
    weight /= weight.sum(axis=1, keepdims=True)
    return (peaks + np.stack([weight @ dx, weight @ dy], axis=1)).astype(np.float32)
