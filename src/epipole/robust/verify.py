"""Verification of a pair of images: which model explains its matches, and what that says about depth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.geometry import Rigid3, Rotation3, triangulate_two_view
from epipole.geometry.epipolar import (
    essential_from_cam2_from_cam1,
    essential_from_fundamental,
    fundamental_from_essential,
)
from epipole.robust.estimate import Estimate
from epipole.robust.pair_kind import PairKind
from epipole.robust.two_view import (
    estimate_fundamental_matrix,
    estimate_homography,
    estimate_relative_pose,
)

SAME_PICTURE_PX = 0.75
"""A median shift of matches below this means that the camera did not move."""
PLANAR_RATIO = 0.8
"""A homography that explains this share of the epipolar inliers makes the pair planar or rotating."""
ROTATION_RATIO = 0.9
"""A pure rotation that explains this share of the inliers makes the pair rotating."""


@dataclass(frozen=True, slots=True, eq=False)
class PairGeometry:
    """What the matches of one pair of images say."""

    kind: PairKind
    inlier_mask: Bool[np.ndarray, " n"]
    cam2_from_cam1: Rigid3
    """|t| = 1, or 0 for a pure rotation; NaN where unknown."""
    essential: Float64[np.ndarray, "3 3"]
    fundamental: Float64[np.ndarray, "3 3"]
    homography: Float64[np.ndarray, "3 3"]
    median_angle_rad: float
    """Median angle between the rays of inliers in front of both cameras; NaN where there is no motion."""


def verify_pair(
    pixels1: np.ndarray,
    pixels2: np.ndarray,
    camera1: Camera,
    camera2: Camera,
    *,
    is_calibrated: bool,
    config: RansacConfig,
) -> PairGeometry:
    """Fit E (calibrated) or F, then H and a rotation, and name what the pair is.

    Args:
        pixels1: matches in image 1, (n, 2).
        pixels2: the same in image 2.
        camera1: the first camera; a guess of the focal length will do where not calibrated.
        camera2: the second camera.
        is_calibrated: both focal lengths can be trusted.
        config: threshold, number of inliers needed and seed.
    """
    n = len(pixels1)
    nothing = Rigid3(np.full((3, 3), np.nan), np.full(3, np.nan))
    blank = np.full((3, 3), np.nan)
    failed = PairGeometry(PairKind.DEGENERATE, np.zeros(n, bool), nothing, blank, blank, blank, float("nan"))
    if n < config.min_inliers:
        return failed
    epipolar, fundamental = _fit_epipolar(
        pixels1, pixels2, camera1, camera2, is_calibrated=is_calibrated, config=config
    )
    if not epipolar.success:
        return failed
    inliers = np.flatnonzero(epipolar.inlier_mask)
    p1, p2 = pixels1[inliers], pixels2[inliers]
    most = min(config.max_iterations, 500)
    plane = estimate_homography(p1, p2, replace(config, max_iterations=most, min_inlier_ratio=PLANAR_RATIO))
    if is_calibrated:
        motion = epipolar.model
        kind, essential = PairKind.GENERAL, essential_from_cam2_from_cam1(motion) / np.sqrt(2.0)
    else:
        kind = PairKind.UNCALIBRATED
        essential, motion = _motion_of_guessed_focal(p1, p2, camera1, camera2, fundamental, config)
    pair = PairGeometry(
        kind,
        epipolar.inlier_mask,
        motion,
        essential,
        fundamental,
        plane.model,
        _median_angle(p1, p2, camera1, camera2, motion),
    )
    if _is_same_picture(p1, p2):
        return replace(pair, kind=PairKind.NO_MOTION, median_angle_rad=float("nan"))
    if plane.num_inliers < PLANAR_RATIO * len(inliers):
        return pair
    rotation, share = _fit_rotation(p1, p2, camera1, camera2, config.max_error_px)
    if share >= ROTATION_RATIO:
        turned = Rigid3(rotation.matrix, np.zeros(3))
        return replace(pair, kind=PairKind.ROTATION, cam2_from_cam1=turned, median_angle_rad=float("nan"))
    return replace(pair, kind=PairKind.PLANAR) if is_calibrated else pair


def find_guide(
    pixels1: np.ndarray,
    pixels2: np.ndarray,
    camera1: Camera,
    camera2: Camera,
    *,
    is_calibrated: bool,
    config: RansacConfig,
) -> Float64[np.ndarray, "3 3"] | None:
    """The fundamental matrix along whose lines more matches may be sought; None where too few agree or none move.

    Args:
        pixels1: matches in image 1, (n, 2).
        pixels2: the same in image 2.
        camera1: the first camera.
        camera2: the second camera.
        is_calibrated: both focal lengths can be trusted.
        config: threshold, number of inliers needed and seed.
    """
    if len(pixels1) < config.min_inliers:
        return None
    epipolar, fundamental = _fit_epipolar(
        pixels1, pixels2, camera1, camera2, is_calibrated=is_calibrated, config=config
    )
    inliers = epipolar.inlier_mask
    if not epipolar.success or _is_same_picture(pixels1[inliers], pixels2[inliers]):
        return None
    return fundamental


def _fit_epipolar(
    pixels1: np.ndarray,
    pixels2: np.ndarray,
    camera1: Camera,
    camera2: Camera,
    *,
    is_calibrated: bool,
    config: RansacConfig,
) -> tuple[Estimate, np.ndarray]:
    """E or F, and the fundamental matrix of length 1 in either case."""
    if not is_calibrated:
        epipolar = estimate_fundamental_matrix(pixels1, pixels2, config)
        return epipolar, epipolar.model
    epipolar = estimate_relative_pose(pixels1, pixels2, camera1, camera2, config)
    essential = essential_from_cam2_from_cam1(epipolar.model)
    fundamental = fundamental_from_essential(essential, camera1.K, camera2.K)
    return epipolar, fundamental / np.linalg.norm(fundamental)


def _is_same_picture(p1: np.ndarray, p2: np.ndarray) -> bool:
    return bool(np.median(np.linalg.norm(p2 - p1, axis=1)) < SAME_PICTURE_PX)


def _motion_of_guessed_focal(
    p1: np.ndarray,
    p2: np.ndarray,
    camera1: Camera,
    camera2: Camera,
    fundamental: np.ndarray,
    config: RansacConfig,
) -> tuple[np.ndarray, Rigid3]:
    """E of the inliers of F under the guessed focal lengths, with a threshold that forgives the guess."""
    loose = replace(config, max_error_px=3.0 * config.max_error_px, max_iterations=200)
    estimate = estimate_relative_pose(p1, p2, camera1, camera2, loose)
    essential = essential_from_fundamental(fundamental, camera1.K, camera2.K)
    return essential / np.linalg.norm(essential), estimate.model


def _median_angle(p1: np.ndarray, p2: np.ndarray, camera1: Camera, camera2: Camera, motion: Rigid3) -> float:
    if not np.isfinite(motion.translation).all():
        return float("nan")
    rays1, rays2 = camera1.unproject(p1), camera2.unproject(p2)
    _, depth1, depth2 = triangulate_two_view(motion, rays1, rays2)
    cosine = np.clip(((rays1 @ motion.rotation.T) * rays2).sum(axis=1), -1.0, 1.0)
    in_front = (depth1 > 0) & (depth2 > 0)
    return float(np.median(np.arccos(cosine[in_front]))) if in_front.any() else float("nan")


def _fit_rotation(
    p1: np.ndarray, p2: np.ndarray, camera1: Camera, camera2: Camera, max_error_px: float
) -> tuple[Rotation3, float]:
    """The rotation that best turns rays 1 into rays 2 (Kabsch 1976), reweighted; and the share it explains."""
    rays1, rays2 = camera1.unproject(p1), camera2.unproject(p2)
    usable = np.isfinite(rays1).all(axis=1) & np.isfinite(rays2).all(axis=1)
    if usable.sum() < 2:
        return Rotation3.identity(), 0.0
    weights = usable.astype(float)
    rays1, rays2 = np.nan_to_num(rays1), np.nan_to_num(rays2)
    within = usable
    rotation = Rotation3.identity()
    for _ in range(8):
        rotation = Rotation3.nearest((rays2 * weights[:, None]).T @ rays1)
        error_px = np.linalg.norm(camera2.project(rotation.apply(rays1)) - p2, axis=1)
        error_px = np.where(np.isfinite(error_px), error_px, np.inf)
        within = usable & (error_px < max_error_px)
        weights = usable / (1.0 + (error_px / max_error_px) ** 2)
    return rotation, float(within.mean())
