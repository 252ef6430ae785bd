"""Things that move: points that disagree with the camera's place, but agree among each other on another one."""

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
"""Of the points that disagree: chance mistakes do not agree on anything."""
MAX_ERROR_PX = 1.5
MAX_ITERATIONS = 300
OFF_PX, ROUGH_PX = 4.0, 3.0
"""One camera: further than this from where a point of the scene can be; and what a homography leaves of a thing with depth."""
NEAREST = 0.2
"""Of the scene's median depth: nearer than that nothing of it is."""
MOST_ROTATION_DEG, MOST_SHIFT = 20.0, 0.3
"""From one image to the next a thing turns by no more, and moves by no larger share of its distance."""


def find_moving_object(
    points_in_world: np.ndarray, pixels: np.ndarray, camera: Camera, position: Rigid3, config: OdometryConfig
) -> MovingThing | None:
    """What points show that were followed into a frame but are not where its place foretells them; None for nothing.

    A rigid thing that moves is to the camera as if the camera were elsewhere: its points agree on another place (P3P in
    RANSAC).

    Args:
        points_in_world: (n, 3) where they were in the last keyframe.
        pixels: (n, 2) where they are seen.
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
    """(n,) how far points are from where a point of the scene can be, whatever its depth.

    Args:
        pixels_then: (n, 2) in an earlier image.
        pixels: where they are seen.
        camera: any model.
        now_from_then: between the images.
        depth: of the scene, in the middle.
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
    """The same of one camera's points that have no place: they are where no point of the scene can be, whatever its depth.

    Args:
        pixels_then: (n, 2) in the last keyframe.
        pixels: (n, 2) where they are seen.
        camera: any model.
        now_from_then: from the keyframe to the frame.
        depth: of the scene, in the middle.
        seed: of the samples.
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
