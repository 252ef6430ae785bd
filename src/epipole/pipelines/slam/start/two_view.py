"""Initialization of a single camera's map from two frames, unless the camera is at rest or only rotates, and its confirmation."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.start.candidate_motions import (
    Judged,
    are_apart,
    judge,
    median_angle_deg,
    median_off_px,
    motions_of_plane,
    rival_of,
)
from epipole.robust import PairKind, triangulate_points, verify_pair

MIN_POINTS = 50
LEAST_SHIFT = 0.015
"""Median shift of the points, as a fraction of the image width, below which no initialization is tried."""
LEAST_ANGLE_DEG = 0.3
"""Smallest triangulation angle of the initialization."""
CONFIRMING_ANGLE = 2.0
"""Later frames confirm the initialization at this multiple of `OdometryConfig.start_angle_deg`."""
MIN_CONFIRMING = 30
"""Points of the first frame that are needed to confirm the initialization."""
MAX_ROTATION_DEG, MAX_DIRECTION_DEG = 1.5, 15.0
"""The map's motion since its first frame may differ this much from the independent estimate, in rotation and direction."""
MAX_EPIPOLAR_PX, MAX_EPIPOLAR_RATIO = 1.0, 3.0
"""A map is contradicted if its epipolar error (median) exceeds both this and this multiple of the independent estimate's."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A two-view initialization, or the reason why there is none."""

    reason: str
    """Empty for an initialization."""
    cam_from_first: Rigid3 | None = None
    """Scaled to a median depth of 1."""
    points_in_first: np.ndarray | None = None
    """(n, 3); NaN for points with too small a triangulation angle or too large an error."""


def try_start(first_px: np.ndarray, pixels: np.ndarray, camera: Camera, config: OdometryConfig) -> Start:
    """Try to initialize a map from two frames.

    Epipolar geometry, a plane, a rotation and no motion compete (Torr's GRIC, in `verify_pair`); the median triangulation angle
    must then be large enough.

    Args:
        first_px: (n, 2) in the first frame.
        pixels: (n, 2) the same points now.
        camera: any model.
        config: the smallest median angle.
    """
    if len(pixels) < MIN_POINTS:
        return Start(f"{len(pixels)} points are tracked, {MIN_POINTS} are needed: blank, dark or blurred")
    shift = float(np.median(np.linalg.norm(pixels - first_px, axis=1)))
    if shift < LEAST_SHIFT * camera.width:
        return Start(f"the points have moved by {shift:.1f} px: the camera hardly moves")
    ransac = RansacConfig(max_error_px=1.5, min_inliers=MIN_POINTS, seed=config.seed)
    found = verify_pair(first_px, pixels, camera, camera, is_calibrated=True, config=ransac)
    if found.kind in (PairKind.ROTATION, PairKind.NO_MOTION):
        return Start("the camera only rotates, which gives no depth: move it sideways")
    if found.kind not in (PairKind.GENERAL, PairKind.PLANAR):
        return Start("the points do not move like those of one rigid scene")
    angle = np.degrees(found.median_angle_rad)
    if not angle >= config.start_angle_deg:
        return _too_narrow(angle, config)
    started = start_by(found.cam2_from_cam1, first_px, pixels, camera, found.inlier_mask)
    assert started.points_in_first is not None
    count = int(np.isfinite(started.points_in_first[:, 0]).sum())
    return (
        started
        if count >= MIN_POINTS
        else Start(f"only {count} points are triangulated, {MIN_POINTS} are needed")
    )


def start_by(
    cam_from_first: Rigid3,
    first_px: np.ndarray,
    pixels: np.ndarray,
    camera: Camera,
    use: np.ndarray | None = None,
) -> Start:
    """Triangulate the points by a motion of unknown scale.

    Args:
        cam_from_first: the motion.
        first_px: (n, 2) in the first frame.
        pixels: the same points now.
        camera: any model.
        use: (n,) mask of the points to triangulate; None: all.
    """
    two = Rigid3.stack([Rigid3.identity(), cam_from_first])
    made = triangulate_points(
        two, camera, np.stack([first_px, pixels]), max_error_px=2.0, min_angle_rad=np.deg2rad(LEAST_ANGLE_DEG)
    )
    good = made.success_mask if use is None else made.success_mask & use
    depth = float(np.median(made.points_in_world[good, 2])) if good.any() else 1.0
    points = np.where(good[:, None], made.points_in_world / depth, np.nan)
    return Start("", Rigid3(cam_from_first.rotation, cam_from_first.translation / depth), points)


def best_start(started: Start, pixels: np.ndarray, camera: Camera, config: OdometryConfig) -> Start:
    """Initialize with the motion that fits all frames best; a reason if another one fits as well.

    Args:
        started: from the first and the last frame.
        pixels: (f, n, 2) of the same points in all frames.
        camera: any model.
        config: the smallest median angle, and the seed.
    """
    assert started.cam_from_first is not None
    judged = _judged([started.cam_from_first], pixels, camera, config)
    best = min(judged, key=lambda one: one.loss)
    if rival_of(best, judged) is not None:
        return Start("the points are near a plane, and two motions explain them: keep moving, along a curve")
    if not best.median_angle_deg >= config.start_angle_deg:
        return _too_narrow(best.median_angle_deg, config)
    if not are_apart(best.cam_from_first, judged[0].cam_from_first):
        return started
    return start_by(best.cam_from_first, pixels[0], pixels[-1], camera)


class Confirmation(Enum):
    """Verdict of later frames on the initialization of a map."""

    OPEN = 0
    CONFIRMED = 1
    REFUTED = 2
    OUT_OF_SIGHT = 3
    """Too few points of the first frame are still tracked."""


def is_wide_enough(
    cam_from_first: Rigid3, first_px: np.ndarray, pixels: np.ndarray, camera: Camera, config: OdometryConfig
) -> bool:
    """Whether the triangulation angles of a motion suffice to confirm an initialization."""
    least_deg = CONFIRMING_ANGLE * config.start_angle_deg
    return median_angle_deg(cam_from_first, first_px, pixels, camera) >= least_deg


def confirm_start(
    cam_from_first: Rigid3, pixels: np.ndarray, camera: Camera, config: OdometryConfig
) -> Confirmation:
    """Compare a map's motion since its first frame with an estimate from image tracks alone.

    Args:
        cam_from_first: motion of the last frame since the first, from the map.
        pixels: (f, n, 2) of the same points in all frames.
        camera: any model.
        config: the smallest median angle, and the seed.
    """
    first, now = pixels[0], pixels[-1]
    ransac = RansacConfig(max_error_px=1.5, min_inliers=MIN_CONFIRMING, seed=config.seed)
    found = verify_pair(first, now, camera, camera, is_calibrated=True, config=ransac)
    epipolar = [found.cam2_from_cam1] if found.kind in (PairKind.GENERAL, PairKind.PLANAR) else []
    judged = _judged([cam_from_first, *epipolar], pixels, camera, config)
    best = min(judged, key=lambda one: one.loss)
    is_wide = best.median_angle_deg >= CONFIRMING_ANGLE * config.start_angle_deg
    if rival_of(best, judged) is not None or not is_wide:
        return Confirmation.OPEN
    if not are_apart(best.cam_from_first, cam_from_first, MAX_ROTATION_DEG, MAX_DIRECTION_DEG):
        return Confirmation.CONFIRMED
    off_px, least_px = (
        median_off_px(motion, first, now, camera) for motion in (cam_from_first, best.cam_from_first)
    )
    return (
        Confirmation.REFUTED
        if off_px > max(MAX_EPIPOLAR_PX, MAX_EPIPOLAR_RATIO * least_px)
        else Confirmation.OPEN
    )


def _judged(
    motions: list[Rigid3], pixels: np.ndarray, camera: Camera, config: OdometryConfig
) -> list[Judged]:
    """These motions and those that a plane allows, in this order, optimized with all frames."""
    of_plane = motions_of_plane(pixels[0], pixels[-1], camera, config.seed)
    return [judge(motion, pixels, camera) for motion in (*motions, *of_plane)]


def _too_narrow(angle_deg: float, config: OdometryConfig) -> Start:
    return Start(
        f"triangulation angle {angle_deg:.2f} degrees, {config.start_angle_deg:g} are needed: keep moving"
    )
