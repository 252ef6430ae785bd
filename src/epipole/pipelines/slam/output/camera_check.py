"""Whether the images agree with the lens that was given: the finished map is adjusted once more with the lens free.

A wrong focal length is partly absorbed by path and points (all of it, where the camera goes straight ahead), and so is a
wrong distortion. What they cannot absorb is what tells: the covariance says how much that is (Triggs et al. 2000,
section 9). It knows nothing of what the model lacks (rows that are read one after another, higher terms of the lens), nor of
the observations that were given up because they did not fit the lens that was given; on real sequences the focal length
found differs by 1 to 3 % from the true one, many times the formal deviation. `FOCAL_ERROR` is for these. A focal length
counts as wrong where the images disagree with it both with the principal point as given and with it free.
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
"""Looked at: those in a row among which the camera turns most."""
LEAST_KEYFRAMES, LEAST_OBSERVATIONS = 4, 500
LEAST_VIEWS = 3
"""Keyframes that see a point: with two all that is wrong with the lens goes into the points."""
MAX_ITERATIONS = 40
WIDEST = 1.5
"""Tangent of the widest angle from the axis, in x and y: beyond, pixels without distortion have other errors."""
FOCAL_ERROR, K1_ERROR = 0.02, 0.015
"""Deviation of what is found, as a share of the focal length (k1: of the radius at the image's edge), besides the formal."""
EDGE = 0.8
"""Of half the image's diagonal: the radius at which a distortion is told in pixels."""
MOST_SIGMAS = 3.0
MOST_SHIFT_PX = 1.0
"""By which the principal point of a pair's second camera may be off, once it was rectified."""
FOCAL, CX, CY, K1, K2 = range(5)
"""Columns of RADIAL's parameters."""


@dataclass(frozen=True, slots=True)
class CameraCheck:
    """The focal length and the first radial term that the images agree with best, besides the distortion given."""

    given_focal_px: float
    focal_px: float
    focal_sigma_px: float
    k1: float
    """In x (1 + k1 r^2) of what the lens given leaves: 0 for one that is right."""
    k1_sigma: float
    edge: float
    """Radius r near the image's edge."""
    sigmas_off: float
    """Between the focal length given and the one found, in standard deviations: with the principal point as given, or, where that
    is wrong, the smaller one of that and of a lens whose principal point is free."""

    @property
    def is_focal_wrong(self) -> bool:
        """Whether the images agree with another focal length than the one given, whatever else of the lens is free."""
        return self.sigmas_off > MOST_SIGMAS

    @property
    def is_distortion_wrong(self) -> bool:
        """Whether the lens has a radial distortion that the one given has not."""
        return abs(self.k1) > MOST_SIGMAS * self.k1_sigma

    def warnings(self) -> list[str]:
        """What is wrong with the lens, in words; empty where nothing is seen to be."""
        found = f"{self.focal_px:.0f} +- {self.focal_sigma_px:.0f} px"
        shift_px = abs(self.k1) * self.edge**3 * self.focal_px
        out = []
        if self.is_focal_wrong:
            out.append(
                f"the focal length given is {self.given_focal_px:.0f} px, the images agree better with"
                f" {found}: if it is wrong, path and map are bent; a calibration tells (epipole calibrate). Rows that are read"
                " one after another (a rolling shutter) look like that, too"
            )
        if self.is_distortion_wrong:
            out.append(
                f"the images are distorted otherwise than the lens given: by a further k1 = {self.k1:.3f} +-"
                f" {self.k1_sigma:.3f} (of RADIAL, OPENCV), {shift_px:.0f} px near the edge; calibrate the camera (epipole"
                " calibrate)"
            )
        return out


def check_camera(model: SlamMap, camera: Camera) -> CameraCheck | None:
    """The lens that the finished map agrees with best; None where the map is too small to tell.

    Args:
        model: which stays as it is.
        camera: as given, of any model.
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
    """What an adjustment finds, and its formal deviations."""

    focal_px: float
    focal_sigma_px: float
    k1: float
    k1_sigma: float

    @property
    def whole_sigma_px(self) -> float:
        """Deviation of the focal length, with what the model lacks."""
        return float(np.hypot(self.focal_sigma_px, FOCAL_ERROR * self.focal_px))

    def sigmas_off(self, given_focal_px: float) -> float:
        """Deviations between the focal length found and one that was given."""
        return abs(self.focal_px - given_focal_px) / self.whole_sigma_px


def _adjusted(problem: BundleProblem, free: tuple[int, ...]) -> _CameraFit | None:
    """The lens, with these of its parameters free; None where they are not determined."""
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
    """Observations in pixels of a pinhole without distortion, from its principal point."""

    views: list[Keyframe]
    frame: np.ndarray
    point: np.ndarray
    pixels: np.ndarray


def _most_rotated(model: SlamMap) -> list[Keyframe]:
    """So many keyframes in a row, with points: a camera that turns as it moves tells its focal length."""
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
    """One lens for all, about the principal point given; lengths have no unit."""
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
    """What is wrong with lens or pair, in words; empty where nothing is seen to be.

    Args:
        found: of the finished map.
        right_shift_px: by how much the principal point of a pair's second camera was found to be off.
    """
    out = [] if found is None else found.warnings()
    if not out and abs(right_shift_px) > MOST_SHIFT_PX:
        out.append(
            f"all disparities of the pair are off by {right_shift_px:.1f} px: its calibration, or its rectification, is not that"
            " of these images"
        )
    return out
