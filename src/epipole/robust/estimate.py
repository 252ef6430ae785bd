"""Robust estimators: one call each, on plain arrays, with a result that says why it failed."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import as_points, require_same_length
from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.geometry import Rigid3, essential_from_cam2_from_cam1
from epipole.robust import _ransac_kernels as kernels


class Reason(StrEnum):
    """Why an estimate failed, or that it did not."""

    OK = "ok"
    TOO_FEW = "fewer matches than the model has unknowns"
    NO_MODEL = "no sample of the matches gave a model"
    TOO_FEW_INLIERS = "too few matches agree with any model"


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What every robust estimator returns; a failure is data."""

    reason: Reason
    inlier_mask: Bool[np.ndarray, " n"]
    residuals_px: Float64[np.ndarray, " n"]
    """Sampson distance, transfer error or reprojection error; infinite where not defined."""
    num_iterations: int
    matrix: Float64[np.ndarray, "3 3"]
    """E, F or H, unit norm (x2^T F x1 = 0; x2 ~ H x1); NaN for a pose alone and for failures."""
    motion: Rigid3
    """cam2_from_cam1 with |t| = 1, or cam_from_world; NaN where the model has none."""

    @property
    def success(self) -> bool:
        """Whether the model can be used."""
        return self.reason is Reason.OK

    @property
    def num_inliers(self) -> int:
        """Matches that agree with the model."""
        return int(self.inlier_mask.sum())

    def __repr__(self) -> str:
        return f"Estimate({self.reason.value}, {self.num_inliers} of {len(self.inlier_mask)} inliers)"


_NO_MOTION = Rigid3(np.full((3, 3), np.nan), np.full(3, np.nan))
_NO_MATRIX = np.full((3, 3), np.nan)


def estimate_essential_matrix(
    pixels1: Any, pixels2: Any, camera1: Camera, camera2: Camera, config: RansacConfig | None = None
) -> Estimate:
    """Relative pose of two calibrated cameras: five points, then truncated Sampson error.

    Args:
        pixels1: matches in image 1, (n, 2).
        pixels2: the same in image 2.
        camera1: any model; points outside its half space in front are outliers.
        camera2: any model.
        config: `max_error_px` is divided by the mean focal length.

    Returns:
        `matrix` = E, `motion` = cam2_from_cam1 with |t| = 1 (the length cannot be known).
    """
    config = config or RansacConfig()
    y1, y2 = rays_on_plane(camera1, pixels1, "pixels1"), rays_on_plane(camera2, pixels2, "pixels2")
    require_same_length(pixels1=y1, pixels2=y2)
    scale_px = 2.0 / (1.0 / camera1.focal_px + 1.0 / camera2.focal_px)

    def finish(model: np.ndarray) -> tuple[np.ndarray, Rigid3]:
        motion = Rigid3(model[:9].reshape(3, 3).copy(), model[9:12].copy())
        essential = essential_from_cam2_from_cam1(motion)
        return essential / np.linalg.norm(essential), motion

    return _run_matches(kernels.EssentialProblem, y1, y2, scale_px, 5, config, finish)


def estimate_fundamental_matrix(pixels1: Any, pixels2: Any, config: RansacConfig | None = None) -> Estimate:
    """Fundamental matrix between pixels (n, 2): seven points, then truncated Sampson error; `matrix` = F."""
    config = config or RansacConfig()
    (q1, t1), (q2, t2), scale_px = _normalized(pixels1, pixels2)

    def finish(model: np.ndarray) -> tuple[np.ndarray, Rigid3]:
        fundamental = t2.T @ model[:9].reshape(3, 3) @ t1
        return fundamental / np.linalg.norm(fundamental), _NO_MOTION

    return _run_matches(kernels.FundamentalProblem, q1, q2, scale_px, 7, config, finish)


def estimate_homography(pixels1: Any, pixels2: Any, config: RansacConfig | None = None) -> Estimate:
    """Homography between pixels (n, 2): four points, then truncated transfer error; `matrix` = H, x2 ~ H x1."""
    config = config or RansacConfig()
    (q1, t1), (q2, t2), scale_px = _normalized(pixels1, pixels2)

    def finish(model: np.ndarray) -> tuple[np.ndarray, Rigid3]:
        homography = np.linalg.solve(t2, model[:9].reshape(3, 3) @ t1)
        return homography / np.linalg.norm(homography), _NO_MOTION

    return _run_matches(kernels.HomographyProblem, q1, q2, scale_px, 4, config, finish)


def estimate_absolute_pose(
    points_in_world: Any, pixels: Any, camera: Camera, config: RansacConfig | None = None
) -> Estimate:
    """Pose of a calibrated camera: P3P, then truncated reprojection error in pixels of the true camera model.

    Args:
        points_in_world: (n, 3).
        pixels: where the camera saw them, (n, 2).
        camera: any model.
        config: `max_error_px` in pixels.

    Returns:
        `motion` = cam_from_world.
    """
    config = config or RansacConfig()
    points, pixels = as_points(points_in_world, "points_in_world", 3), as_points(pixels, "pixels", 2)
    n = require_same_length(points_in_world=points, pixels=pixels)
    rays = camera.unproject(pixels)
    usable = np.flatnonzero(np.isfinite(rays).all(axis=1) & np.isfinite(points).all(axis=1))
    if len(usable) < 3:
        return _failure(Reason.TOO_FEW, n)
    problem = kernels.AbsolutePoseProblem(
        np.ascontiguousarray(points[usable].T),
        np.ascontiguousarray(rays[usable]),
        np.ascontiguousarray(pixels[usable].T),
        int(camera.model),
        camera.padded_params(),
        float(config.max_error_px**2),
    )
    model, residuals, iterations = _run(problem, len(usable), config)
    if model is None:
        return _failure(Reason.NO_MODEL, n, iterations)
    motion = Rigid3(model[:9].reshape(3, 3).copy(), model[9:12].copy())
    return _result(n, usable, np.sqrt(residuals), config, iterations, _NO_MATRIX, motion)


def rays_on_plane(camera: Camera, pixels: Any, name: str = "pixels") -> Float64[np.ndarray, "n 2"]:
    """Where the rays of pixels (n, 2) cross the plane z = 1 before the camera; NaN where they do not."""
    rays = camera.unproject(as_points(pixels, name, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rays[:, 2:] > 1e-3, rays[:, :2] / rays[:, 2:], np.nan)


def _normalized(
    pixels1: Any, pixels2: Any
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray], float]:
    """Both images centred and divided by one common length, so that one threshold serves both."""
    p1, p2 = as_points(pixels1, "pixels1", 2), as_points(pixels2, "pixels2", 2)
    require_same_length(pixels1=p1, pixels2=p2)
    finite = np.isfinite(p1).all(axis=1) & np.isfinite(p2).all(axis=1)
    if not finite.any():
        return (p1, np.eye(3)), (p2, np.eye(3)), 1.0
    c1, c2 = p1[finite].mean(axis=0), p2[finite].mean(axis=0)
    spread = max(float(np.std(p1[finite])), float(np.std(p2[finite])), 1e-9) * np.sqrt(2.0)
    out = []
    for p, c in ((p1, c1), (p2, c2)):
        t = np.array([[1 / spread, 0, -c[0] / spread], [0, 1 / spread, -c[1] / spread], [0, 0, 1]])
        out.append(((p - c) / spread, t))
    return out[0], out[1], spread


def _run_matches(
    kind: Any, q1: np.ndarray, q2: np.ndarray, scale_px: float, least: int, config: RansacConfig, finish: Any
) -> Estimate:
    n = len(q1)
    usable = np.flatnonzero(np.isfinite(q1).all(axis=1) & np.isfinite(q2).all(axis=1))
    if len(usable) < least:
        return _failure(Reason.TOO_FEW, n)
    matches = np.ascontiguousarray(np.concatenate([q1[usable], q2[usable]], axis=1).T)
    problem = kind(matches, float((config.max_error_px / scale_px) ** 2))
    model, residuals, iterations = _run(problem, len(usable), config)
    if model is None:
        return _failure(Reason.NO_MODEL, n, iterations)
    matrix, motion = finish(model)
    return _result(n, usable, np.sqrt(residuals) * scale_px, config, iterations, matrix, motion)


def _run(problem: Any, n: int, config: RansacConfig) -> tuple[np.ndarray | None, np.ndarray, int]:
    model, residuals = np.zeros(kernels.MODEL_SIZE), np.full(n, np.inf)
    score, iterations = kernels.ransac(
        problem,
        config.confidence,
        config.min_iterations,
        config.max_iterations,
        min(1.0, max(config.min_inlier_ratio, config.min_inliers / n)),
        config.seed,
        model,
        residuals,
    )
    return (model if np.isfinite(score) else None), residuals, int(iterations)


def _result(
    n: int,
    usable: np.ndarray,
    residuals: np.ndarray,
    config: RansacConfig,
    iterations: int,
    matrix: np.ndarray,
    motion: Rigid3,
) -> Estimate:
    residuals_px = np.full(n, np.inf)
    residuals_px[usable] = residuals
    inlier_mask = residuals_px < config.max_error_px
    reason = Reason.OK if inlier_mask.sum() >= config.min_inliers else Reason.TOO_FEW_INLIERS
    return Estimate(reason, inlier_mask, residuals_px, iterations, matrix, motion)


def _failure(reason: Reason, n: int, iterations: int = 0) -> Estimate:
    return Estimate(reason, np.zeros(n, bool), np.full(n, np.inf), iterations, _NO_MATRIX, _NO_MOTION)
