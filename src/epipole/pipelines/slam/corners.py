"""Where new points begin: corners, away from those that are there."""

from __future__ import annotations

import cv2
import numpy as np

from epipole.pipelines.slam.config import SlamConfig


def new_corners(grey: np.ndarray, present_px: np.ndarray, config: SlamConfig) -> np.ndarray:
    """(n, 2) corners (Shi and Tomasi, CVPR 1994) to a fraction of a pixel, strongest first, up to the number asked for."""
    wanted = config.num_features - len(present_px)
    if wanted <= 0:
        return np.zeros((0, 2))
    mask = np.full(grey.shape, 255, np.uint8)
    for x, y in np.rint(present_px).astype(int):
        cv2.circle(mask, (int(x), int(y)), config.min_distance_px, 0, -1)
    found = cv2.goodFeaturesToTrack(
        grey, wanted, config.corner_quality, config.min_distance_px, mask=mask, blockSize=5
    )
    if found is None:
        return np.zeros((0, 2))
    side = config.flow.window_px // 2
    inside = (found[:, 0] >= side).all(axis=1) & (found[:, 0] < np.array(grey.shape[::-1]) - side).all(axis=1)
    return found[inside, 0].astype(np.float64)
