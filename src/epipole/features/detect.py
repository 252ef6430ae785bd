"""Detection and description: SIFT (Lowe, IJCV 2004), and ORB (Rublee et al., ICCV 2011) by OpenCV."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from epipole._checks import checked
from epipole.config import FeatureConfig, options_of
from epipole.features.features import Features, in_order
from epipole.features.kinds import KINDS, ORB, Detector
from epipole.features.sift import detect_sift

_MANY = 1 << 20
_opencv: Any = cv2  # its stubs lack ORB


@checked
def detect_features(gray: UInt8[np.ndarray, "h w"], config: FeatureConfig | None = None) -> Features:
    """Detect and describe features of a gray image; none in a blank or tiny image.

    Returns:
        Features in pixels of the given image, even if it was downscaled for detection.
    """
    config = options_of(FeatureConfig, config)
    height, width = gray.shape
    if min(height, width) < 16:
        return _none(KINDS[config.kind].width)
    factor = min(1.0, config.max_size_px / max(height, width))
    if factor < 1.0:
        size = (max(16, round(width * factor)), max(16, round(height * factor)))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    found = DETECTORS[config.kind](gray, config)
    if factor == 1.0:
        return found
    # Resampling aligns pixel edges, not centers.
    stretch = np.array([width / gray.shape[1], height / gray.shape[0]])
    pixels = ((found.pixels + 0.5) * stretch - 0.5).astype(np.float32)
    return Features(
        pixels, (found.scale_px * stretch.mean()).astype(np.float32), found.angle_rad, found.descriptors
    )


def detect_orb(gray: np.ndarray, config: FeatureConfig) -> Features:
    """ORB by OpenCV (Rublee et al., ICCV 2011)."""
    keypoints, descriptors = _opencv.ORB_create(
        nfeatures=min(config.max_features, max(gray.size, _MANY))
    ).detectAndCompute(gray, None)
    if not keypoints:
        return _none(ORB.width)
    columns = np.array([(*k.pt, k.size, np.deg2rad(k.angle)) for k in keypoints], np.float32)
    return in_order(columns, descriptors, config.max_features)  # OpenCV's own order depends on its threads


def _none(width: int) -> Features:
    empty = np.zeros(0, np.float32)
    return Features(np.zeros((0, 2), np.float32), empty, empty.copy(), np.zeros((0, width), np.uint8))


DETECTORS: dict[str, Detector] = {"sift": detect_sift, "orb": detect_orb}
"""By `FeatureConfig.kind`."""
