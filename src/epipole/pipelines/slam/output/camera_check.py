"""Check the given intrinsics against the images: bundle adjustment of the finished map with free intrinsics.

The trajectory and the points absorb a wrong focal length or distortion in part (the focal length completely in straight
forward motion). The rest determines the intrinsics, and the covariance says how well (Triggs et al. 2000, section 9). It
ignores model errors (rolling shutter, higher distortion terms) and the observations that were rejected because they did not
fit the given intrinsics: on real sequences the estimated focal length is 1 to 3 % off, many formal standard deviations.
`FOCAL_ERROR` accounts for these. A focal length counts as wrong only if the images contradict it both with the principal
point as given and with it free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.optim import (
    BundleConfig,
    BundleProblem,
    Loss,
    adjust_bundle,
    bundle_covariance,
    with_fixed_gauge,
    with_result,
)
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap

MOST_KEYFRAMES = 60
"""Consecutive keyframes that are adjusted: those with the largest total rotation."""
LEAST_KEYFRAMES, LEAST_OBSERVATIONS = 4, 500
LEAST_VIEWS = 3
"""Keyframes that must see a point: with two, the point absorbs all errors of the intrinsics."""
MAX_ITERATIONS = 40
WIDEST = 1.5
"""Tangent of the largest angle from the axis, in x and y: beyond it, undistorted pixels have other errors."""
FOCAL_ERROR = 0.02
"""Relative standard deviation of the focal length due to model errors, added to the formal one."""
K1_ERROR = 0.015
"""The same for k1, as the relative change of the radius near the image's edge."""
EDGE = 0.8
"""Radius at which distortion is reported in pixels, as a fraction of half the image diagonal."""
MOST_SIGMAS = 3.0
MOST_SHIFT_PX = 1.0
"""Tolerated principal point error of a rectified pair's second camera."""
FOCAL, CX, CY, K1, K2 = range(5)
"""Columns of the RADIAL parameters."""


@dataclass(frozen=True, slots=True)
class CameraCheck:
    """Focal length and remaining radial distortion that fit the images best."""

    given_focal_px: float
    focal_px: float
    focal_sigma_px: float
    k1: float
    """Remaining distortion x (1 + k1 r^2) after undistortion with the given intrinsics; 0 if these are right."""
    k1_sigma: float
    edge: float
    """Normalized radius r near the image's edge."""
    sigmas_off: float
    """Difference between given and estimated focal length in standard deviations: with the given principal point or, if that is
    too large, the smaller of the differences with the given and with a free principal point."""

    @property
    def is_focal_wrong(self) -> bool:
        """Whether the images contradict the given focal length."""
        return self.sigmas_off > MOST_SIGMAS

    @property
    def is_distortion_wrong(self) -> bool:
        """Whether the images contradict the given radial distortion."""
        return abs(self.k1) > MOST_SIGMAS * self.k1_sigma

    def warnings(self) -> list[str]:
        """Warnings about wrong intrinsics."""
        found = f"{self.focal_px:.0f} +- {self.focal_sigma_px:.0f} px"
        shift_px = abs(self.k1) * self.edge**3 * self.focal_px
        out = []
        if self.is_focal_wrong:
            out.append(
                f"the given focal length is {self.given_focal_px:.0f} px, but the images fit {found} better: a wrong focal"
                " length bends trajectory and map. Calibrate the camera (epipole calibrate); a rolling shutter can look the"
                " same"
            )
        if self.is_distortion_wrong:
            out.append(
                f"the images do not fit the given distortion: they need a further k1 = {self.k1:.3f} +- {self.k1_sigma:.3f}"
                f" (as in RADIAL, OPENCV), {shift_px:.0f} px near the edge. Calibrate the camera (epipole calibrate)"
            )
        return out


def check_camera(model: SlamMap, camera: Camera) -> CameraCheck | None:
    """Estimate the intrinsics that fit the finished map best; None if the map is too small.

    Args:
        model: the map, which is not changed.
        camera: the given intrinsics, any model.
    """
    seen = _observations(_most_rotated(model), model, camera)
    if seen is None:
        return None
    problem = _problem(seen, model, camera.focal_px)
    narrow = _adjusted(problem, (FOCAL, K1))
    if narrow is None:
        return None
    sigmas_off = narrow.sigmas_off(camera.focal_px)
    if sigmas_off > MOST_SIGMAS:  # unless another principal point explains it
        wide = _adjusted(problem, (FOCAL, CX, CY, K1, K2))
        if wide is None:
            return None
        sigmas_off = min(sigmas_off, wide.sigmas_off(camera.focal_px))
    focal_px, k1 = narrow.focal_px, narrow.k1
    edge = EDGE * 0.5 * float(np.hypot(camera.width, camera.height)) / focal_px
    return CameraCheck(
        camera.focal_px,
        focal_px,
        narrow.whole_sigma_px,
        k1,
        float(np.hypot(narrow.k1_sigma, K1_ERROR / edge**2)),
        edge,
        sigmas_off,
    )


class _CameraFit(NamedTuple):
    """Estimated parameters and their formal standard deviations."""

    focal_px: float
    focal_sigma_px: float
    k1: float
    k1_sigma: float

    @property
    def whole_sigma_px(self) -> float:
        """Standard deviation of the focal length, including model errors."""
        return float(np.hypot(self.focal_sigma_px, FOCAL_ERROR * self.focal_px))

    def sigmas_off(self, given_focal_px: float) -> float:
        """Difference between estimated and given focal length, in standard deviations."""
        return abs(self.focal_px - given_focal_px) / self.whole_sigma_px


def _adjusted(problem: BundleProblem, free: tuple[int, ...]) -> _CameraFit | None:
    """Adjust with these intrinsics free; None if they are not determined."""
    params_free = np.zeros_like(problem.params_free)
    params_free[0, list(free)] = 1.0
    problem = replace(problem, params_free=params_free)
    config = BundleConfig(
        loss=Loss.CAUCHY, loss_scale_px=1.0, max_iterations=MAX_ITERATIONS, function_tolerance=1e-5
    )
    result = adjust_bundle(problem, config)
    try:
        found = bundle_covariance(with_result(problem, result), result, config, clustered=True)
    except DegenerateGeometryError:
        return None
    camera, variance = result.camera_params[0], np.diagonal(found.camera_params[0])
    if not (np.isfinite([*camera[list(free)], *variance[[FOCAL, K1]]]).all() and camera[FOCAL] > 0):
        return None
    return _CameraFit(
        float(camera[FOCAL]), float(np.sqrt(variance[FOCAL])), float(camera[K1]), float(np.sqrt(variance[K1]))
    )


class _Seen(NamedTuple):
    """Observations in undistorted pixels relative to the principal point."""

    views: list[Keyframe]
    frame: np.ndarray
    point: np.ndarray
    pixels: np.ndarray


def _most_rotated(model: SlamMap) -> list[Keyframe]:
    """The `MOST_KEYFRAMES` consecutive keyframes that determine the focal length best: those with most rotation."""
    views = [k for k in model.keyframes if model.is_triangulated(k.point).any()]
    if len(views) <= MOST_KEYFRAMES:
        return views
    rotations = [(b.cam_from_world @ a.cam_from_world.inverse()).rotation for a, b in pairwise(views)]
    angles = np.arccos(np.clip([(np.trace(rotation) - 1.0) / 2.0 for rotation in rotations], -1.0, 1.0))
    together = np.convolve(angles, np.ones(MOST_KEYFRAMES - 1), "valid")
    first = int(np.argmax(together))
    return views[first : first + MOST_KEYFRAMES]


def _observations(views: list[Keyframe], model: SlamMap, camera: Camera) -> _Seen | None:
    if len(views) < LEAST_KEYFRAMES:
        return None
    parts = []
    for row, own in enumerate(views):
        rays = camera.unproject(own.straight_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = rays[:, :2] / rays[:, 2:]
        used = model.is_triangulated(own.point) & (rays[:, 2] > 0) & (np.abs(at) < WIDEST).all(axis=1)
        parts.append((np.full(int(used.sum()), row), own.point[used], camera.focal_px * at[used]))
    frame, point, pixels = (np.concatenate(column) for column in zip(*parts))
    kept = (np.bincount(point, minlength=model.num_points) >= LEAST_VIEWS)[point]
    if kept.sum() < LEAST_OBSERVATIONS:
        return None
    return _Seen(views, frame[kept], point[kept], pixels[kept])


def _problem(seen: _Seen, model: SlamMap, focal_px: float) -> BundleProblem:
    """One camera for all keyframes, with pixels relative to the given principal point; lengths have no unit."""
    rows, point = np.unique(seen.point, return_inverse=True)
    order = np.argsort(point, kind="stable")
    none = np.zeros(len(order), np.int32)
    params = np.zeros((1, 12))
    params[0, FOCAL] = focal_px
    positions = [keyframe.cam_from_world for keyframe in seen.views]
    return with_fixed_gauge(
        BundleProblem(
            Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions])),
            Rigid3(np.eye(3)[None], np.zeros((1, 3))),
            np.array([int(CameraModel.RADIAL)], np.int32),
            params,
            model.xyz[rows].copy(),
            np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(rows)))]).astype(np.int64),
            seen.frame[order].astype(np.int32),
            none,
            none,
            seen.pixels[order],
            np.ones((len(positions), 6)),
            np.zeros((1, 12)),
            np.ones(len(rows)),
        )
    )


def camera_warnings(found: CameraCheck | None, right_shift_px: float) -> list[str]:
    """Warnings about wrong intrinsics or a wrong stereo calibration.

    Args:
        found: result for the finished map.
        right_shift_px: estimated principal point error of a pair's second camera.
    """
    out = [] if found is None else found.warnings()
    if not out and abs(right_shift_px) > MOST_SHIFT_PX:
        out.append(
            f"all stereo disparities are off by {right_shift_px:.1f} px: the calibration or the rectification does not match"
            " these images"
        )
    return out
