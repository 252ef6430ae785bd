"""Things that move: points that disagree with the camera's place, but agree among each other on another one."""

from __future__ import annotations

import numpy as np

from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import MovingThing
from epipole.robust import estimate_absolute_pose

LEAST_POINTS = 15
LEAST_SHARE = 0.5
"""Of the points that disagree: chance mistakes do not agree on anything."""
MAX_ERROR_PX = 1.5
MAX_ITERATIONS = 300
MOST_TURN_DEG, MOST_SHIFT = 20.0, 0.3
"""From one picture to the next a thing turns by no more, and moves by no larger share of its distance."""


def second_motion(
    points_in_world: np.ndarray, pixels: np.ndarray, camera: Camera, place: Rigid3, config: SlamConfig
) -> MovingThing | None:
    """What points show that were followed into a frame but are not where its place foretells them; None for nothing.

    A rigid thing that moves is to the camera as if the camera were elsewhere: its points agree on another place (P3P in
    RANSAC).

    Args:
        points_in_world: (n, 3) where they were in the last keyframe.
        pixels: (n, 2) where they are seen.
        camera: any model.
        place: cam_from_world of the frame.
        config: the seed.
    """
    if len(pixels) < LEAST_POINTS:
        return None
    ransac = RansacConfig(
        max_error_px=MAX_ERROR_PX,
        min_inliers=LEAST_POINTS,
        min_inlier_ratio=LEAST_SHARE,
        max_iterations=MAX_ITERATIONS,
        seed=config.seed,
    )
    found = estimate_absolute_pose(points_in_world, pixels, camera, ransac)
    agrees = found.inlier_mask
    if not found.success or agrees.sum() < LEAST_SHARE * len(pixels):
        return None
    moved = place.inverse() @ found.model
    there = moved.apply(points_in_world[agrees])
    center = np.median(points_in_world[agrees], axis=0)
    motion = np.median(there - points_in_world[agrees], axis=0)
    angle_deg = np.degrees(np.linalg.norm(moved.log()[3:]))
    if angle_deg > MOST_TURN_DEG or np.linalg.norm(motion) > MOST_SHIFT * np.linalg.norm(place.apply(center)):
        return None
    (left, top), (right, bottom) = np.percentile(pixels[agrees], [5.0, 95.0], axis=0).tolist()
    return MovingThing(int(agrees.sum()), (left, top), (right, bottom), motion)
