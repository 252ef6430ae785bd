"""Triangulation of calibrated views: optimal for two, robust for more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from epipole import _parallel
from epipole._checks import as_float_array, as_points, check_squarable, checked
from epipole.cameras import MAX_PARAMS, Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3, essential_from_cam2_from_cam1
from epipole.robust import _triangulation_kernels as kernels

_CHUNKS = 16


class PointReason(IntEnum):
    """Why a point could not be triangulated, or OK."""

    OK = kernels.OK
    TOO_FEW_VIEWS = kernels.TOO_FEW_VIEWS
    """Fewer than two pixels with a ray."""
    SMALL_ANGLE = kernels.SMALL_ANGLE
    """Its rays intersect at a smaller angle than required: the depth is unknown."""
    BEHIND_CAMERA = kernels.BEHIND_CAMERA
    """Its rays intersect behind a camera."""
    LARGE_ERROR = kernels.LARGE_ERROR
    """No two views agree on a point within the threshold."""


@dataclass(frozen=True, slots=True, eq=False)
class Triangulation:
    """Triangulated points and their quality."""

    points_in_world: Float64[np.ndarray, "n 3"]
    """NaN if there is none; points behind a camera or with too small an angle are included."""
    reason: Int64[np.ndarray, " n"]
    """Values of `PointReason`."""
    errors_px: Float64[np.ndarray, " n"]
    """RMS of a residual coordinate over the inlier views."""
    cosines: Float64[np.ndarray, " n"]
    """Cosine of the largest angle between two of its rays."""
    inlier_mask: Bool[np.ndarray, "v n"]
    """Views that agree with the point."""

    @property
    def angles_rad(self) -> Float64[np.ndarray, " n"]:
        """The largest angle between two of its rays."""
        return np.arccos(np.clip(self.cosines, -1.0, 1.0))

    @property
    def success_mask(self) -> Bool[np.ndarray, " n"]:
        """Points that can be used."""
        return self.reason == PointReason.OK

    def __repr__(self) -> str:
        return f"Triangulation({int(self.success_mask.sum())} of {len(self.reason)} points)"


@checked
def triangulate_points(
    cams_from_world: Rigid3,
    cameras: Camera | Sequence[Camera],
    pixels: Any,
    *,
    max_error_px: float | None = None,
    min_angle_rad: float = 0.0,
) -> Triangulation:
    """Points with the least sum of squared reprojection errors.

    Two views: the optimal correction of Lindstrom (CVPR 2010). More: the pair of views that most others agree with, then
    Gauss-Newton on the actual camera models, over the views within the threshold.

    Args:
        cams_from_world: batch shape (v,).
        cameras: one for all views, or one per view.
        pixels: (v, n, 2), NaN where a view does not see the point.
        max_error_px: views with larger errors are outliers; None: all views are used.
        min_angle_rad: points with a smaller ray angle are `PointReason.SMALL_ANGLE`.

    Raises:
        ShapeError: array sizes do not match.
        ConfigError: a bound is out of range.
    """
    pixels = as_float_array(pixels, "pixels")
    num_views = len(cams_from_world)
    if pixels.ndim != 3 or pixels.shape[0] != num_views or pixels.shape[2] != 2:
        raise ShapeError(f"pixels must be ({num_views}, n, 2), a row of pixels per view, got {pixels.shape}")
    each = _camera_of_each(cams_from_world, cameras)
    if max_error_px is not None and not max_error_px > 0:
        raise ConfigError(f"max_error_px must be positive, got {max_error_px}")
    check_squarable(max_error_px or 0.0, "max_error_px")
    if not 0 <= min_angle_rad < np.pi:
        raise ConfigError(f"min_angle_rad must lie in [0, pi), got {min_angle_rad}")
    max_cosine = float(np.cos(min_angle_rad)) if min_angle_rad > 0 else 1.0
    if num_views == 2:
        return _two_views(cams_from_world, each, pixels, max_error_px, max_cosine)
    return _many_views(cams_from_world, each, pixels, max_error_px, max_cosine)


@checked
def point_covariances(
    cams_from_world: Rigid3,
    cameras: Camera | Sequence[Camera],
    points_in_world: Any,
    seen_mask: Bool[np.ndarray, "v n"],
    noise_px: float,
) -> Float64[np.ndarray, "n 3 3"]:
    """First-order covariances of triangulated points: sigma^2 (sum over views of J^T J)^-1 (HZ section 5.2).

    Args:
        cams_from_world: batch shape (v,), assumed exact.
        cameras: one for all views, or one per view.
        points_in_world: (n, 3).
        seen_mask: (v, n), the views that were used.
        noise_px: standard deviation of a pixel coordinate.

    Returns:
        Infinite if the views do not determine the point.

    Raises:
        ShapeError: array sizes do not match.
        ConfigError: noise_px is negative.
    """
    points = as_points(points_in_world, "points_in_world", 3)
    each = _camera_of_each(cams_from_world, cameras)
    if seen_mask.shape != (len(each), len(points)):
        raise ShapeError(f"seen_mask must be {(len(each), len(points))}, got {seen_mask.shape}")
    if not 0 <= noise_px < np.inf:
        raise ConfigError(f"noise_px must be finite and not negative, got {noise_px}")
    check_squarable(noise_px, "noise_px")
    information = np.zeros((len(points), 3, 3))
    for view, camera in enumerate(each):
        _, jacobian, _ = camera.project_with_jacobian(cams_from_world[view].apply(points))
        in_world = np.where(seen_mask[view][:, None, None], jacobian @ cams_from_world[view].rotation, 0.0)
        information += np.swapaxes(in_world, 1, 2) @ in_world
    return covariances_of_information(information, noise_px)


def covariances_of_information(
    information: Float64[np.ndarray, "n 3 3"], noise_px: float
) -> Float64[np.ndarray, "n 3 3"]:
    """sigma^2 (sum of J^T J)^-1 of each point; infinite if a direction is undetermined."""
    out = np.full(information.shape, np.inf)
    usable = np.flatnonzero(np.isfinite(information).all(axis=(1, 2)))
    values = np.linalg.eigvalsh(information[usable])
    usable = usable[values[:, 0] > 1e-14 * values[:, 2]]
    out[usable] = noise_px**2 * np.linalg.inv(information[usable])
    return out


def _camera_of_each(cams_from_world: Rigid3, cameras: Camera | Sequence[Camera]) -> list[Camera]:
    if len(cams_from_world.batch_shape()) != 1:
        raise ShapeError(
            f"cams_from_world must have a batch of one axis, got {cams_from_world.batch_shape()}"
        )
    num_views = len(cams_from_world)
    each = [cameras] * num_views if isinstance(cameras, Camera) else list(cameras)
    if len(each) != num_views:
        raise ShapeError(f"cameras must be one, or one per view ({num_views}), got {len(each)}")
    return each


def _two_views(
    cams_from_world: Rigid3,
    cameras: list[Camera],
    pixels: np.ndarray,
    max_error_px: float | None,
    max_cosine: float,
) -> Triangulation:
    n = pixels.shape[1]
    motion = cams_from_world[1] @ cams_from_world[0].inverse()
    out = (np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(n, np.int64))
    essential = essential_from_cam2_from_cam1(motion).ravel()
    models = np.array([int(c.model) for c in cameras])
    params = np.stack([c.padded_params() for c in cameras])
    row = np.concatenate([motion.rotation.ravel(), motion.translation])
    focal = np.array([c.focal_px for c in cameras])
    _parallel.map_chunks(
        lambda a, b, _: kernels.triangulate_two_views(
            models, params, row, essential, focal, max_cosine, pixels[0], pixels[1], a, b, out
        ),
        n,
        _CHUNKS if n > 2000 else 1,
    )
    points, errors, cosines, reason = out
    if max_error_px is not None:
        # Both views share the error: the distance in each is sqrt(2) times the RMS of a coordinate.
        reason[(np.sqrt(2.0) * errors > max_error_px) & (reason == PointReason.OK)] = PointReason.LARGE_ERROR
    identity = (
        np.array_equal(cams_from_world.rotation[0], np.eye(3)) and not cams_from_world.translation[0].any()
    )
    if not identity:
        points = cams_from_world[0].inverse().apply(points)
    ok = reason == PointReason.OK
    return Triangulation(points, reason, errors, cosines, np.broadcast_to(ok, (2, n)))


def _many_views(
    cams_from_world: Rigid3,
    cameras: list[Camera],
    pixels: np.ndarray,
    max_error_px: float | None,
    max_cosine: float,
) -> Triangulation:
    num_views, n = pixels.shape[:2]
    point, view = np.nonzero(np.isfinite(pixels).all(axis=2).T)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=n))]).astype(np.int64)
    rays = np.stack([camera.unproject(p) for camera, p in zip(cameras, pixels)]) if num_views else pixels
    rows = kernels.Rows(view.astype(np.int32), pixels[view, point], rays[view, point].reshape(-1, 3))
    cams = kernels.Cams(
        np.concatenate([cams_from_world.rotation.reshape(-1, 9), cams_from_world.translation], axis=1),
        cams_from_world.centers(),
        np.arange(num_views, dtype=np.int32),
        np.array([int(c.model) for c in cameras], np.int32),
        np.stack([c.padded_params() for c in cameras]) if cameras else np.zeros((0, MAX_PARAMS)),
    )
    out = (np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(n, np.int64))
    keep = np.zeros(len(point), bool)
    longest = int(np.diff(offsets).max(initial=0))
    bound = np.inf if max_error_px is None else float(max_error_px**2)
    _parallel.map_chunks(
        lambda a, b, _: kernels.triangulate_many_views(
            rows, cams, offsets, a, b, bound, max_cosine, longest, out, keep
        ),
        n,
        _CHUNKS if n > 200 else 1,
    )
    points, errors, cosines, reason = out
    inliers = np.zeros((num_views, n), bool)
    inliers[view[keep], point[keep]] = True
    return Triangulation(points, reason, errors, cosines, inliers)
