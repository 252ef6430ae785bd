"""How the map of one camera begins: two frames apart enough, told from a turning and from a resting camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import SlamConfig
from epipole.robust import PairKind, triangulate_points, verify_pair

MIN_POINTS = 50
LEAST_SHIFT = 0.015
"""Median shift of the points, as a share of the picture's width, below which nothing is tried."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """The begin of a map, or what it waits for."""

    reason: str
    """Empty for a begin."""
    cam_from_first: Rigid3 | None = None
    """With the median depth of the points at 1."""
    points_in_first: np.ndarray | None = None
    """(n, 3), NaN for points under too narrow an angle, or that do not fit."""


def try_start(first_px: np.ndarray, pixels: np.ndarray, camera: Camera, config: SlamConfig) -> Start:
    """Whether two frames make a begin.

    Epipolar geometry, a plane, a rotation and no motion compete (Torr's GRIC, in `verify_pair`); the rays must then meet
    under a wide enough median angle.

    Args:
        first_px: (n, 2) where the points were in the first frame.
        pixels: where they are now.
        camera: any model.
        config: the angle.
    """
    if len(pixels) < MIN_POINTS:
        return Start(f"{len(pixels)} points are followed, {MIN_POINTS} are needed: blank, dark or blurred")
    shift = float(np.median(np.linalg.norm(pixels - first_px, axis=1)))
    if shift < LEAST_SHIFT * camera.width:
        return Start(f"the points have moved by {shift:.1f} px: the camera hardly moves")
    ransac = RansacConfig(max_error_px=1.5, min_inliers=MIN_POINTS, seed=config.seed)
    found = verify_pair(first_px, pixels, camera, camera, is_calibrated=True, config=ransac)
    if found.kind in (PairKind.ROTATION, PairKind.NO_MOTION):
        return Start("the camera only turns: no depth can be had from that; move it sideways")
    if found.kind not in (PairKind.GENERAL, PairKind.PLANAR):
        return Start("the points do not move as those of one rigid scene")
    angle = np.degrees(found.median_angle_rad)
    if not angle >= config.start_angle_deg:
        return Start(f"the rays meet at {angle:.2f} degrees, {config.start_angle_deg:g} are needed: move on")
    two = Rigid3(
        np.stack([np.eye(3), found.cam2_from_cam1.rotation]),
        np.stack([np.zeros(3), found.cam2_from_cam1.translation]),
    )
    made = triangulate_points(
        two, camera, np.stack([first_px, pixels]), max_error_px=2.0, min_angle_rad=np.deg2rad(0.3)
    )
    good = made.success_mask & found.inlier_mask
    if good.sum() < MIN_POINTS:
        return Start(f"only {int(good.sum())} points get a place, {MIN_POINTS} are needed")
    depth = float(np.median(made.points_in_world[good, 2]))
    points = np.where(good[:, None], made.points_in_world / depth, np.nan)
    motion = Rigid3(found.cam2_from_cam1.rotation, found.cam2_from_cam1.translation / depth)
    return Start("", motion, points)
