"""Detection and description: SIFT (Lowe, IJCV 2004) and ORB (Rublee et al., ICCV 2011), by OpenCV."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from epipole.config import FeatureConfig
from epipole.features.features import Features

_opencv: Any = cv2  # its stubs lack SIFT and ORB


def detect_features(grey: UInt8[np.ndarray, "h w"], config: FeatureConfig | None = None) -> Features:
    """Find and describe features of a grey picture; none in a blank or tiny one.

    Returns:
        Features in pixels of the given picture, also when it was reduced for detection.
    """
    config = config or FeatureConfig()
    height, width = grey.shape
    if min(height, width) < 16:
        return _none(128 if config.kind == "sift" else 32)
    factor = min(1.0, config.max_size_px / max(height, width))
    if factor < 1.0:
        size = (max(16, round(width * factor)), max(16, round(height * factor)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    found = _sift(grey, config) if config.kind == "sift" else _orb(grey, config)
    if factor == 1.0:
        return found
    # Pixel edges, not centres, stay put under resampling.
    stretch = np.array([width / grey.shape[1], height / grey.shape[0]])
    pixels = ((found.pixels + 0.5) * stretch - 0.5).astype(np.float32)
    return Features(
        pixels, (found.scale_px * stretch.mean()).astype(np.float32), found.angle_rad, found.descriptors
    )


def _sift(grey: np.ndarray, config: FeatureConfig) -> Features:
    # Without precise upscaling the doubled first octave shifts every keypoint by a quarter of a pixel.
    detector = _opencv.SIFT_create(
        nfeatures=0,
        contrastThreshold=config.contrast_threshold,
        enable_precise_upscale=True,
    )
    keypoints, descriptors = detector.detectAndCompute(grey, None)
    if not keypoints:
        return _none(128)
    return _sorted(keypoints, root_sift(descriptors), config.max_features)


def root_sift(descriptors: Float32[np.ndarray, "n 128"]) -> UInt8[np.ndarray, "n 128"]:
    """Square roots of L1-normalised SIFT, times 512, as bytes (Arandjelovic and Zisserman, CVPR 2012)."""
    values = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)
    return np.minimum(np.rint(512.0 * np.sqrt(values)), 255).astype(np.uint8)


def _orb(grey: np.ndarray, config: FeatureConfig) -> Features:
    keypoints, descriptors = _opencv.ORB_create(nfeatures=config.max_features).detectAndCompute(grey, None)
    return _sorted(keypoints, descriptors, config.max_features) if keypoints else _none(32)


def _sorted(keypoints: tuple[cv2.KeyPoint, ...], descriptors: np.ndarray, limit: int) -> Features:
    """Columns ordered by falling size, then position: OpenCV's own order depends on its threads."""
    columns = np.array([(*k.pt, k.size, k.angle) for k in keypoints], np.float32)
    order = np.lexsort((columns[:, 3], columns[:, 0], columns[:, 1], -columns[:, 2]))[:limit]
    columns = columns[order]
    return Features(
        np.ascontiguousarray(columns[:, :2]),
        columns[:, 2].copy(),
        np.deg2rad(columns[:, 3]),
        np.ascontiguousarray(descriptors[order]),
    )


def _none(width: int) -> Features:
    empty = np.zeros(0, np.float32)
    return Features(np.zeros((0, 2), np.float32), empty, empty.copy(), np.zeros((0, width), np.uint8))
