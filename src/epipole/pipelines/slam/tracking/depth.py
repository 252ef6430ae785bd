"""Disparities of points in a single frame, from a second camera or from a depth sensor."""

from __future__ import annotations

import cv2
import numpy as np

from epipole.cameras import Camera
from epipole.features.patches import find_along_rows, find_patches
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera

ROWS_PX = 1.0
"""Largest distance of a match in the right image from its row."""
LEAST_SCORE = 0.7
LEAST_LEAD = 0.05
"""Score of the best match in a row minus that of the second best."""
LARGEST_FRACTION = 0.2
"""Largest disparity searched, as a fraction of the image width."""
GUESS_LEVELS = 2
ROUNDS, USUAL_STEP = 4, 8
SMOOTH = 0.03
"""Largest relative difference of the depths around a point; beyond it the point is on an edge and its depth ambiguous."""


def disparities_of(
    frame: Frame, pixels: np.ndarray, guess_px: np.ndarray, camera: SlamCamera, config: OdometryConfig
) -> np.ndarray:
    """(n,) disparity f B / Z of points, in pixels; NaN if not measured.

    Args:
        frame: the images.
        pixels: (n, 2) in the left, or color, image.
        guess_px: (n,) initial disparities; NaN if unknown.
        camera: cameras of the pair or of the depth sensor.
        config: the depth sensor's equivalent baseline.
    """
    none = np.full(len(pixels), np.nan)
    if frame.depth is not None:
        assert camera.depth is not None
        z = depth_at(frame.depth, pixels, camera.camera, camera.depth)
        return camera.camera.focal_px * config.sensor_baseline_m / z
    if frame.right_gray is None or not len(pixels):
        return none
    guess, unknown = guess_px.copy(), ~np.isfinite(guess_px)
    guess[unknown] = _best_shifts(frame.gray, frame.right_gray, pixels[unknown])
    start = pixels - np.stack([guess, np.zeros(len(pixels))], axis=1)
    same = np.tile(np.eye(2), (len(pixels), 1, 1))
    right, score = find_patches(frame.gray, frame.right_gray, pixels, same, start, GUESS_LEVELS)
    disparity = pixels[:, 0] - right[:, 0]
    found = (score > LEAST_SCORE) & (np.abs(right[:, 1] - pixels[:, 1]) <= ROWS_PX) & (disparity > 0.3)
    return np.where(found, disparity, np.nan)


def _best_shifts(left: np.ndarray, right: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n,) disparities within two pixels, from a search along the row at half resolution; NaN if ambiguous."""
    most = int(left.shape[1] * LARGEST_FRACTION / 2)
    shift, score, rival = find_along_rows(cv2.pyrDown(left), cv2.pyrDown(right), pixels / 2, most)
    return np.where((score > LEAST_SCORE) & (score - rival > LEAST_LEAD), 2 * shift, np.nan)


def points_by_disparity(
    pixels: np.ndarray, disparity: np.ndarray, camera: Camera, focal_baseline: float, most_baselines: float
) -> np.ndarray:
    """(n, 3) points in the camera frame, at depth f B / d; NaN without a disparity, or beyond `most_baselines` baselines."""
    out = np.full((len(pixels), 3), np.nan)
    near = np.flatnonzero(disparity >= camera.focal_px / most_baselines)
    rays = camera.unproject(pixels[near])
    out[near] = rays / rays[:, 2:] * (focal_baseline / disparity[near])[:, None]
    return out


def depth_at(depth: np.ndarray, pixels: np.ndarray, camera: Camera, sensor: DepthCamera) -> np.ndarray:
    """(n,) depth of pixels of the color image in its camera's frame; NaN if not measured, or at an edge.

    Fixed-point iteration: a point at depth z projects into the depth image, whose value there is the next z. It converges in a
    few rounds, since sensors are centimeters from their color cameras.
    """
    rays = camera.unproject(pixels)
    rays = rays / rays[:, 2:]
    z, moved = np.full(len(pixels), _usual_depth(depth)), sensor.depth_from_color
    for _ in range(ROUNDS):
        at = sensor.camera.project(moved.apply(rays * z[:, None]))
        read = sensor.scale * _smooth_depth(depth, np.where(np.isfinite(at), at, -1.0))
        # The optical axes are not parallel, so the two depths differ slightly.
        in_sensor = moved.apply(rays * z[:, None])[:, 2]
        z = np.where(np.isfinite(read), read * z / np.maximum(in_sensor, 1e-6), z)
    return np.where(np.isfinite(read), z, np.nan)


def _usual_depth(depth: np.ndarray) -> float:
    """Median of the measured depths of every eighth row and column (of all, if none is measured there); 1 without any."""
    for sample in (depth[::USUAL_STEP, ::USUAL_STEP], depth):
        known = sample[(sample > 0) & (sample < np.inf)]
        if len(known):
            return float(np.median(known))
    return 1.0


def _smooth_depth(depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Depth at pixels of the sensor; NaN outside the image, where unmeasured, and at edges."""
    height, width = depth.shape
    column, row = np.rint(pixels).astype(int).T
    inside = (column >= 1) & (column < width - 1) & (row >= 1) & (row < height - 1)
    column, row = np.clip(column, 1, width - 2), np.clip(row, 1, height - 2)
    around = np.stack([depth[row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]).astype(
        np.float64
    )
    around[~((around > 0) & (around < np.inf))] = np.nan
    middle = around[4]
    spread = np.max(np.abs(around - middle), axis=0)  # NaN if any is unknown
    return np.where(inside & (spread <= SMOOTH * middle), middle, np.nan)
