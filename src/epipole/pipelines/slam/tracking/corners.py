"""Detection of new corners that exceed the image noise, away from existing points."""

from __future__ import annotations

import cv2
import numpy as np

from epipole.cameras import Camera
from epipole.pipelines.slam.config import OdometryConfig
from epipole.scene import CameraRig

BLOCK_PX = 5
NOISE_FACTOR = 7.0
"""Smallest ratio of a corner's smaller eigenvalue to that of noise alone. At 7, noise moves a corner by a quarter of a pixel."""
LEAST_FRACTION = 0.375
"""A camera of a rig has at least this fraction of the features of a single camera."""
LEAST_NOISE = 0.5
"""In gray levels. Rounding alone contributes a third."""


def new_corners(
    gray: np.ndarray,
    present_px: np.ndarray,
    config: OdometryConfig,
    ignored_mask: np.ndarray | None = None,
    camera: Camera | CameraRig | None = None,
) -> np.ndarray:
    """(n, 2) corners (Shi and Tomasi, CVPR 1994), strongest first, to fill up the present ones to `num_features`.

    In the stacked image of a rig, each camera has an equal part of them, or more if the cameras are many: one in bad light still
    needs its own.
    """
    if not isinstance(camera, CameraRig):
        return _corners(gray, present_px, config.num_features, config, ignored_mask)
    which, found = camera.camera_of(present_px), []
    masks = [None] * len(camera.cameras) if ignored_mask is None else camera.parts(ignored_mask)
    for k, part in enumerate(camera.parts(gray)):
        top = [0.0, float(camera.tops[k])]
        count = int(max(1.0 / len(camera.cameras), LEAST_FRACTION) * config.num_features)
        found.append(_corners(part, present_px[which == k] - top, count, config, masks[k]) + top)
    return np.concatenate(found)


def _corners(
    gray: np.ndarray,
    present_px: np.ndarray,
    count: int,
    config: OdometryConfig,
    ignored_mask: np.ndarray | None,
) -> np.ndarray:
    wanted = count - len(present_px)
    if wanted <= 0:
        return np.zeros((0, 2))
    mask = np.full(gray.shape, 255, np.uint8)
    if ignored_mask is not None:
        mask[ignored_mask] = 0
    for x, y in np.rint(present_px).astype(int):
        cv2.circle(mask, (int(x), int(y)), config.min_distance_px, 0, -1)
    found, strength = cv2.goodFeaturesToTrackWithQuality(
        gray, wanted, config.corner_quality, config.min_distance_px, mask, blockSize=BLOCK_PX
    )
    if found is None:
        return np.zeros((0, 2))
    side = config.window_px // 2
    corners, last = found[:, 0].astype(np.float64), np.array(gray.shape[::-1]) - side
    inside = (corners >= side).all(axis=1) & (corners < last).all(axis=1)
    return corners[inside & (strength.ravel() > NOISE_FACTOR * _strength_of_noise(noise_of(gray)))]


def noise_of(gray: np.ndarray) -> float:
    """Standard deviation of an image's noise in gray levels, from its smoothest quarter.

    Uses the second difference along rows and columns, which is zero for planes (Immerkaer, CVIU 1996), with the lower quartile of
    its absolute value instead of the mean, so that texture has no effect.
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    difference = np.abs(cv2.filter2D(gray, cv2.CV_32F, kernel)[::4, ::4]).astype(np.int64)
    # Differences are integers; each represents an interval of +-0.5.
    fraction = np.cumsum(np.bincount(difference.ravel())) / difference.size
    ends = np.arange(len(fraction) + 1) - 0.5
    ends[0] = 0.0
    quartile = np.interp(0.25, np.concatenate([[0.0], fraction]), ends)
    return max(LEAST_NOISE, float(quartile) / (0.3186 * 6.0))


def _strength_of_noise(sigma: float) -> float:
    """OpenCV's smaller eigenvalue for white noise: 12 sigma^2 for each Sobel gradient, summed over the block."""
    scale = 1.0 / (4.0 * BLOCK_PX * 255.0)
    return BLOCK_PX**2 * 12.0 * sigma**2 * scale**2
