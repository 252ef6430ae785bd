"""Moving objects: points that disagree with the camera's pose but agree with each other on a different one."""

from __future__ import annotations

import numpy as np

from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import MovingThing
from epipole.robust import estimate_absolute_pose, estimate_homography

LEAST_POINTS = 15
LEAST_FRACTION = 0.5
"""Of the points that disagree. Random mismatches do not agree with each other."""
MAX_ERROR_PX = 1.5
MAX_ITERATIONS = 300
OFF_PX = 4.0
"""Smallest distance of a moving point from its epipolar segment (single camera)."""
ROUGH_PX = 3.0
"""Largest residual of a homography for an object with depth (single camera)."""
NEAREST = 0.2
"""Nearest depth of the scene, as a fraction of its median depth."""
MOST_ROTATION_DEG = 20.0
"""Largest rotation of an object between two images."""
MOST_SHIFT = 0.3
"""Largest motion of an object between two images, as a fraction of its distance."""


def find_moving_object(
    points_in_world: np.ndarray, pixels: np.ndarray, camera: Camera, position: Rigid3, config: OdometryConfig
) -> MovingThing | None:
    """The rigid object that explains tracked points which disagree with the frame's pose; None if there is none.

    A moving rigid object is equivalent to a different camera pose, which is estimated from its points (P3P in RANSAC).

    Args:
        points_in_world: (n, 3) positions in the last keyframe.
        pixels: (n, 2) observations in the frame.
        camera: any model.
        position: cam_from_world of the frame.
        config: the seed.
    """
    if len(pixels) < LEAST_POINTS:
        return None
    ransac = RansacConfig(
        max_error_px=MAX_ERROR_PX,
        min_inliers=LEAST_POINTS,
        min_inlier_ratio=LEAST_FRACTION,
        max_iterations=MAX_ITERATIONS,
        seed=config.seed,
    )
    found = estimate_absolute_pose(points_in_world, pixels, camera, ransac)
    agrees = found.inlier_mask
    if not found.success or agrees.sum() < LEAST_FRACTION * len(pixels):
        return None
    moved = position.inverse() @ found.model
    there = moved.apply(points_in_world[agrees])
    center = np.median(points_in_world[agrees], axis=0)
    motion = np.median(there - points_in_world[agrees], axis=0)
    angle_deg = np.degrees(np.linalg.norm(moved.log()[3:]))
    if angle_deg > MOST_ROTATION_DEG or np.linalg.norm(motion) > MOST_SHIFT * np.linalg.norm(
        position.apply(center)
    ):
        return None
    return _thing(pixels[agrees], motion)


def off_px_of_scene(
    pixels_then: np.ndarray, pixels: np.ndarray, camera: Camera, now_from_then: Rigid3, depth: float
) -> np.ndarray:
    """(n,) distance of points from their epipolar segments, on which a static point of any depth projects, in pixels.

    Args:
        pixels_then: (n, 2) in an earlier image.
        pixels: (n, 2) in the present image.
        camera: any model.
        now_from_then: motion between the images.
        depth: median depth of the scene.
    """
    rays = camera.unproject(pixels_then)
    rays = rays / np.maximum(rays[:, 2:], 1e-6)
    far = camera.project(now_from_then.apply(1e3 * depth * rays))
    near = camera.project(now_from_then.apply(NEAREST * depth * rays))
    along = near - far
    fraction = np.einsum("ni,ni->n", pixels - far, along) / np.maximum(
        np.einsum("ni,ni->n", along, along), 1e-9
    )
    return np.linalg.norm(far + np.clip(fraction, 0.0, 1.0)[:, None] * along - pixels, axis=1)


def find_moving_object_in_image(
    pixels_then: np.ndarray,
    pixels: np.ndarray,
    camera: Camera,
    now_from_then: Rigid3,
    depth: float,
    seed: int,
) -> MovingThing | None:
    """The moving object that explains a single camera's untriangulated points away from their epipolar segments; None if none.

    Args:
        pixels_then: (n, 2) in the last keyframe.
        pixels: (n, 2) in the frame.
        camera: any model.
        now_from_then: motion from the keyframe to the frame.
        depth: median depth of the scene.
        seed: random seed of RANSAC.
    """
    if len(pixels) < LEAST_POINTS:
        return None
    off = off_px_of_scene(pixels_then, pixels, camera, now_from_then, depth) > OFF_PX
    if off.sum() < LEAST_POINTS:
        return None
    ransac = RansacConfig(
        max_error_px=ROUGH_PX,
        min_inliers=LEAST_POINTS,
        min_inlier_ratio=LEAST_FRACTION,
        max_iterations=MAX_ITERATIONS,
        seed=seed,
    )
    found = estimate_homography(pixels_then[off], pixels[off], ransac)
    agrees = found.inlier_mask
    if not found.success or agrees.sum() < LEAST_FRACTION * off.sum():
        return None
    return _thing(pixels[off][agrees], np.full(3, np.nan))


def _thing(pixels: np.ndarray, motion: np.ndarray) -> MovingThing:
    (left, top), (right, bottom) = np.percentile(pixels, [5.0, 95.0], axis=0).tolist()
    return MovingThing(len(pixels), (left, top), (right, bottom), motion)
