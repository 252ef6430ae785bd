"""An object of known size in the images of a model: its pose, and the model's scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import Declared, checked
from epipole._damped import minimize
from epipole.cameras import Camera
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3, Similarity3, align_points
from epipole.geometry.rotation3 import skew
from epipole.robust import triangulate_points
from epipole.robust.triangulate import PointReason

MIN_ANGLE_DEG = 1.0
OUTLIER = (
    4.0  # views with a larger rms error, in standard deviations or relative to the median view, are dropped
)
LARGEST_ERROR = 8.0  # largest accepted rms error of the fit, in standard deviations
MAX_STEPS, DAMPING = 50, 1e-3
LARGEST = 1e12
"""Upper bound of lengths and pixels, to keep the arithmetic finite."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectFit(Declared):
    """A known object fitted to the cameras of a model."""

    model_from_object: Similarity3
    scale: float
    """Meters per model unit."""
    sigma: float
    """Standard deviation of the scale, from pixel noise and pose covariance."""
    residual: float
    """RMS of the pixel errors, in standard deviations."""
    kept_mask: Bool[np.ndarray, " v"]
    """Views that agree with the fit."""

    def __repr__(self) -> str:
        return f"ObjectFit(scale {self.scale:.6g} +- {self.sigma:.2g}, {int(self.kept_mask.sum())} of {len(self.kept_mask)} views)"


class _Seen(NamedTuple):
    """The views that see the object."""

    cams_from_world: Rigid3
    cameras: list[Camera]
    pixels: np.ndarray
    sigma_px: float
    covariance: np.ndarray

    def rows(self, mask: np.ndarray) -> _Seen:
        rows = np.flatnonzero(mask)
        cameras = [self.cameras[v] for v in rows]
        return _Seen(
            self.cams_from_world[rows], cameras, self.pixels[rows], self.sigma_px, self.covariance[rows]
        )


@checked
def fit_scale_to_object(
    points_in_object: Float64[np.ndarray, "n 3"],
    cams_from_world: Rigid3,
    cameras: Sequence[Camera],
    pixels: Float64[np.ndarray, "v n 2"],
    sigma_px: float,
    cam_covariance: Float64[np.ndarray, "v 6 6"] | None = None,
) -> ObjectFit:
    """The similarity from an object to the model with the least reprojection error, and its scale's standard deviation.

    X = c + s R P is found by Gauss-Newton over (c, R, log s), starting from the triangulated points. The pixels of one
    view share its pose error: with J_xi = d pixel / d xi, the covariance of a view's pixels is
    sigma^2 I + J_xi C J_xi^T. With two points the rotation about their line is undetermined, which does not affect the
    scale. Views whose pixels do not fit are dropped as long as two others agree.

    Args:
        points_in_object: corners of a board or tag, or the ends of a length, in meters.
        cams_from_world: the model's cameras that see it, batch shape (v,).
        cameras: intrinsics of each view.
        pixels: observations of the points; NaN where a view does not see a point.
        sigma_px: standard deviation of a pixel coordinate.
        cam_covariance: of xi = (translation, rotation) in exp(xi) @ cam_from_world; None: poses are exact.

    Raises:
        DegenerateGeometryError: too little parallax, or pixels that do not fit such an object.
        ShapeError: array sizes do not match.
        ConfigError: sigma_px is not positive.
    """
    num_views = len(cameras)
    covariance = np.zeros((num_views, 6, 6)) if cam_covariance is None else cam_covariance
    if len(covariance) != num_views:
        raise ShapeError(f"cam_covariance must have {num_views} rows, as cameras has, got {len(covariance)}")
    _check(points_in_object, cams_from_world, pixels, sigma_px, covariance)
    known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(cams_from_world.translation).all(axis=1)
    kept = known & np.isfinite(pixels).all(axis=2).any(axis=1)
    seen = _Seen(
        cams_from_world, list(cameras), pixels, sigma_px, np.where(known[:, None, None], covariance, 0.0)
    )
    middle = points_in_object.mean(axis=0)
    shape = points_in_object - middle
    for _ in range(max(num_views, 1)):
        try:
            found, sigma_log, errors = _fit(shape, seen.rows(kept))
        except np.linalg.LinAlgError as error:
            raise DegenerateGeometryError("its pixels do not determine its pose") from error
        size = np.full(num_views, np.nan)
        size[kept] = errors
        limit = OUTLIER * max(1.0, float(np.nanmedian(size)))
        if not (size > limit).any() or kept.sum() <= 2:
            break
        kept = kept & ~(size > limit)
    residual = float(np.sqrt(np.mean(size[kept] ** 2)))
    if residual > LARGEST_ERROR:
        raise DegenerateGeometryError(
            f"its pixels do not fit an object of this shape: the rms error is {residual * sigma_px:.1f} px"
        )
    scale = 1.0 / float(found.scale)
    moved = Similarity3(found.scale, found.rotation, found.apply(-middle[None])[0])
    return ObjectFit(moved, scale, scale * sigma_log, residual, kept)


def _check(
    points: np.ndarray, cams_from_world: Rigid3, pixels: np.ndarray, sigma_px: float, covariance: np.ndarray
) -> None:
    num_views = len(covariance)
    if not 0 < sigma_px < LARGEST:
        raise ConfigError(f"sigma_px must be positive and below {LARGEST:g}, got {sigma_px}")
    if cams_from_world.batch_shape() != (num_views,) or len(pixels) != num_views:
        raise ShapeError(
            f"cams_from_world, cam_covariance and pixels must have {num_views} rows, as cameras has"
        )
    if len(points) < 2 or pixels.shape[1] != len(points):
        raise ShapeError("points_in_object must have at least two rows, and pixels one column per point")
    for name, values in (("points_in_object", points), ("pixels", pixels), ("cam_covariance", covariance)):
        if (np.abs(values[np.isfinite(values)]) > LARGEST).any():
            raise ShapeError(f"{name} must be below {LARGEST:g}")
    if not np.isfinite(points).all() or np.isinf(pixels).any():
        raise ShapeError("points_in_object must be finite, and pixels finite or NaN")


def _start(shape: np.ndarray, seen: _Seen) -> Similarity3:
    """From the triangulated points."""
    if len(seen.cameras) < 2:
        raise DegenerateGeometryError(
            f"seen in {len(seen.cameras) or 'no'} posed image{'' if len(seen.cameras) == 1 else 's'}: two from "
            "different positions are needed"
        )
    found = triangulate_points(
        seen.cams_from_world, seen.cameras, seen.pixels, min_angle_rad=np.deg2rad(MIN_ANGLE_DEG)
    )
    good = found.success_mask
    away = shape[good] - shape[good][:1]
    if good.sum() < 2 or not away.any():
        raise DegenerateGeometryError(_why_no_points(found.reason, seen))
    points = found.points_in_world[good]
    if np.linalg.matrix_rank(away, tol=1e-6 * np.abs(away).max()) >= 2:
        return align_points(shape[good], points)
    rows = np.flatnonzero(good)
    last = int(np.argmax(np.linalg.norm(shape[rows] - shape[rows[0]], axis=1)))
    here, there = shape[rows[last]] - shape[rows[0]], points[last] - points[0]
    scale = np.linalg.norm(there) / np.linalg.norm(here)
    if not scale > 0:
        raise DegenerateGeometryError("its two ends coincide in the images")
    rotation = Rotation3.from_two_vectors(here, there).matrix
    return Similarity3(np.asarray(scale), rotation, points[0] - scale * rotation @ shape[rows[0]])


def _why_no_points(reason: np.ndarray, seen: _Seen) -> str:
    """The reason in words, from the status of the points and the largest angle between two rays to one point."""
    if (reason == PointReason.TOO_FEW_VIEWS).any():
        return "one of its ends is seen in one image only: two from different positions are needed"
    rays = np.stack(
        [c.unproject(p) @ r for c, p, r in zip(seen.cameras, seen.pixels, seen.cams_from_world.rotation)]
    )
    cosine = np.einsum("vnk,wnk->nvw", rays, rays)
    if np.nanmin(cosine, initial=1.0) > np.cos(np.deg2rad(MIN_ANGLE_DEG)):
        return f"too little parallax: its rays intersect at less than {MIN_ANGLE_DEG:g} degree"
    return "its pixels in two images intersect behind a camera"


def _fit(shape: np.ndarray, seen: _Seen) -> tuple[Similarity3, float, np.ndarray]:
    """The similarity, the standard deviation of its log scale, and each view's rms error in standard deviations."""
    start = _start(shape, seen)
    found, residual, jacobian, sizes = minimize(
        (start, *_equations(start, shape, seen)),
        cost=lambda state: float(state[1] @ state[1]),
        linearize=lambda state: (state[2].T @ state[2], state[2].T @ state[1]),
        step=lambda state, equations, damping: _moved(state[0], equations, damping, shape, seen),
        damping=DAMPING,
        tolerance=1e-10,
        max_steps=MAX_STEPS,
    )
    normal = jacobian.T @ jacobian
    unit = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal * unit[:, None] * unit, rcond=1e-12, hermitian=True)
    freedom = len(residual) - np.linalg.matrix_rank(normal * unit[:, None] * unit, tol=1e-9, hermitian=True)
    excess = max(1.0, float(residual @ residual) / freedom) if freedom > 0 else 1.0
    return found, float(np.sqrt(excess * inverse[6, 6]) * unit[6]), sizes


def _moved(
    found: Similarity3,
    equations: tuple[np.ndarray, np.ndarray],
    damping: float,
    shape: np.ndarray,
    seen: _Seen,
) -> tuple[Similarity3, np.ndarray, np.ndarray, np.ndarray]:
    """The similarity after a damped step, with its equations."""
    normal, gradient = equations
    damped = normal + damping * np.diag(np.maximum(np.diag(normal), 1e-12 * normal.max()))
    step = -np.linalg.solve(damped, gradient)
    moved = Similarity3(
        np.asarray(float(found.scale) * np.exp(np.clip(step[6], -1.0, 1.0))),
        found.rotation @ Rotation3.exp(step[3:6]).matrix,
        found.translation + step[:3],
    )
    return moved, *_equations(moved, shape, seen)


def _equations(
    found: Similarity3, shape: np.ndarray, seen: _Seen
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whitened residuals, their Jacobian by (center, rotation, log scale), and each view's rms error in sigma_px."""
    points, scale, rotation = found.apply(shape), float(found.scale), found.rotation
    by_object = np.empty((len(shape), 3, 7))
    by_object[:, :, :3] = np.eye(3)
    by_object[:, :, 3:6] = -scale * rotation @ skew(shape)
    by_object[:, :, 6] = scale * shape @ rotation.T
    residuals, jacobians, sizes = [], [], np.empty(len(seen.cameras))
    for v, camera in enumerate(seen.cameras):
        rows = np.flatnonzero(np.isfinite(seen.pixels[v]).all(axis=1))
        in_cam = seen.cams_from_world[v].apply(points[rows])
        at, by_point, _ = camera.project_with_jacobian(in_cam)
        by_cam = np.concatenate([by_point, -by_point @ skew(in_cam)], axis=2).reshape(-1, 6)
        off = (at - seen.pixels[v, rows]).ravel()
        sizes[v] = np.sqrt(np.mean(off**2)) / seen.sigma_px
        spread = seen.sigma_px**2 * np.eye(len(off)) + by_cam @ seen.covariance[v] @ by_cam.T
        jacobian = (by_point @ seen.cams_from_world.rotation[v] @ by_object[rows]).reshape(-1, 7)
        if not (np.isfinite(off).all() and np.isfinite(spread).all()):
            residuals.append(np.full(len(off), np.inf))
            jacobians.append(jacobian)
            continue
        whiten = np.linalg.inv(np.linalg.cholesky(spread))
        residuals.append(whiten @ off)
        jacobians.append(whiten @ jacobian)
    return np.concatenate(residuals), np.concatenate(jacobians), sizes
