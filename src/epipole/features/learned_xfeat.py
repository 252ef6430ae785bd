"""Keypoints and descriptors from the maps of XFeat (Potje, Cadar, Araujo, Martins and Nascimento, CVPR 2024)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Int64, UInt8

from epipole.features.map_sampling import cubic_weights, linear_weights, sample_map

_STRIDE_PX = 32
"""The network takes images whose sides are multiples of it."""
_CELL_PX = 8
"""Side of the pixel block that one element of the maps describes."""
_MIN_VARIANCE = 1e-5
"""Added to the variance of an image with intensities from 0 to 1, as in XFeat, so that blank images stay finite."""
_MIN_HEAT = 0.05
"""Probability that a pixel of its cell is a keypoint; XFeat's detection_threshold."""
_NMS_PX = 5
"""Side of the window in which a keypoint has the highest probability; as in XFeat."""


def detect_xfeat(
    network: Any, image: UInt8[np.ndarray, "h w *channels"], max_num: int, max_size_px: int
) -> tuple[Float32[np.ndarray, "n 2"], Float32[np.ndarray, " n"], Float32[np.ndarray, "n 64"]]:
    """Pixels, scores and descriptors of the features with the highest scores; see `LearnedFeatures.detect`."""
    height, width = image.shape[:2]
    resized = network_image(image, max_size_px)
    maps = network.run(None, {"image": resized[None, None]})
    descriptors, logits, reliability = (each[0] for each in maps)
    found, scores = select_keypoints(keypoint_heat(logits), reliability, max_num)
    size = resized.shape[::-1]
    sampled = sample_map(descriptors, cell_positions(found, size), cubic_weights)
    length = np.maximum(np.linalg.norm(sampled, axis=1, keepdims=True), np.float32(1e-12))
    # Resampling aligns pixel edges, not centers.
    pixels = (found + 0.5) * (np.array([width, height]) / size) - 0.5
    return pixels.astype(np.float32), scores, sampled / length


def network_image(image: UInt8[np.ndarray, "h w *channels"], max_size_px: int) -> Float32[np.ndarray, "p q"]:
    """The mean of the channels, resized to multiples of 32 pixels that are not larger, with mean 0 and variance 1."""
    gray = image.astype(np.float32) if image.ndim == 2 else image.mean(axis=2, dtype=np.float32)
    height, width = gray.shape
    factor = min(1.0, max_size_px / max(height, width))
    size = [max(1, int(side * factor) // _STRIDE_PX) * _STRIDE_PX for side in (width, height)]
    # Averaging avoids aliasing; XFeat's own resizing to multiples of 32, by less than a factor of two, is bilinear.
    interpolation = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_LINEAR
    resized = np.asarray(cv2.resize(gray, size, interpolation=interpolation)) / np.float32(255.0)
    mean, variance = resized.mean(dtype=np.float64), resized.var(dtype=np.float64)
    return (resized - np.float32(mean)) / np.float32(np.sqrt(variance + _MIN_VARIANCE))


def keypoint_heat(logits: Float32[np.ndarray, "65 h w"]) -> Float32[np.ndarray, "p q"]:
    """Probability of each pixel (8 h, 8 w) that it is the keypoint of its cell, a softmax; the last logit means none."""
    exponential = np.exp(logits - logits.max(axis=0))
    heat = exponential[:-1] / exponential.sum(axis=0)
    _, rows, columns = heat.shape
    blocks = heat.reshape(_CELL_PX, _CELL_PX, rows, columns).transpose(2, 0, 3, 1)
    return np.ascontiguousarray(blocks.reshape(rows * _CELL_PX, columns * _CELL_PX))


def select_keypoints(
    heat: Float32[np.ndarray, "p q"], reliability: Float32[np.ndarray, "1 h w"], max_num: int
) -> tuple[Int64[np.ndarray, "n 2"], Float32[np.ndarray, " n"]]:
    """Local maxima (x, y) of the heat with the highest scores, and their scores; equal scores in reading order.

    XFeat drops maxima in the last row and column, where its sampling of the heat leaves the image.
    """
    highest = cv2.dilate(heat, np.ones((_NMS_PX, _NMS_PX), np.uint8))
    is_peak = (heat == highest) & (heat > _MIN_HEAT)
    y, x = np.nonzero(is_peak[:-1, :-1])
    found = np.stack([x, y], axis=1)
    at = cell_positions(found, heat.shape[::-1])
    scores = heat[y, x] * sample_map(reliability, at, linear_weights)[:, 0]
    order = np.argsort(-scores, kind="stable")[:max_num]
    return found[order], scores[order]


def cell_positions(pixels: Int64[np.ndarray, "n 2"], size: tuple[int, int]) -> Float32[np.ndarray, "n 2"]:
    """Where XFeat samples its maps for pixels of an image of this width and height, in elements of the map.

    The center of a cell would be at (pixel + 0.5) / 8 - 0.5. XFeat differs by up to 1/16 of an element, and so did the
    descriptors with which LighterGlue was trained.
    """
    sides = np.array(size)
    return (pixels * (sides / _CELL_PX) / (sides - 1) - 0.5).astype(np.float32)
