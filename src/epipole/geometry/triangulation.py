"""Triangulation: intersection of back-projected rays."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import (
    as_directions,
    as_float_array,
    as_points,
    check_broadcast,
    checked,
    require_same_length,
)
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry.rigid3 import Rigid3


@checked
def triangulate_linear(cams_from_world: Rigid3, rays: Any) -> Float64[np.ndarray, 3]:
    """The point closest to n >= 2 rays in the DLT sense (HZ section 12.2, with unit rays).

    Each view contributes [d]x (R X + t) = 0; the homogeneous system is solved by SVD. A point at infinity, or rays without a
    unique point (no baseline), give NaN.

    Args:
        cams_from_world: batch shape (n,).
        rays: directions in each camera, (n, 3), any length.

    Raises:
        DegenerateGeometryError: fewer than two rays.
        ShapeError: array sizes do not match, or a value is not finite.
    """
    rays = as_points(rays, "rays", 3, finite=True)
    if len(cams_from_world.batch_shape()) != 1:
        raise ShapeError(
            f"cams_from_world must have a batch of one axis, got {cams_from_world.batch_shape()}"
        )
    if not np.isfinite(cams_from_world.as_matrix()).all():
        raise ShapeError("cams_from_world must be finite")
    if require_same_length(cams_from_world=cams_from_world.translation, rays=rays) < 2:
        raise DegenerateGeometryError(f"triangulation needs at least 2 rays, got {len(rays)}")
    d = as_directions(rays, "rays")
    # The component of R X + t orthogonal to d vanishes: (I - d d^T) [R t] X = 0.
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    scale = np.abs(cams_from_world.translation).max() or 1.0
    system = across @ np.concatenate(
        [cams_from_world.rotation, cams_from_world.translation[:, :, None] / scale], axis=2
    )
    _, singular, vt = np.linalg.svd(system.reshape(-1, 4), full_matrices=False)
    rounding = 1e-14
    if singular[2] < rounding * singular[0] or abs(vt[3, 3]) < rounding:
        return np.full(3, np.nan)
    return scale * vt[3, :3] / vt[3, 3]


@checked
def triangulate_two_view(
    cam2_from_cam1: Rigid3, rays1: Any, rays2: Any
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Midpoints of the shortest segments between matched rays, with the depths along both.

    Solves min |a R d1 + t - b d2| for each match: with n = R d1 x d2, a = (d2 x t) . n / |n|^2 and
    b = (R d1 x t) . n / |n|^2, which remains accurate for small angles. Parallel rays give NaN.

    Args:
        cam2_from_cam1: a single motion.
        rays1: directions in camera 1, (n, 3), any length.
        rays2: the same in camera 2.

    Returns:
        Points in camera 1; distance along ray 1; distance along ray 2 (negative: behind).

    Raises:
        ShapeError: array sizes do not match.
    """
    if cam2_from_cam1.batch_shape() != ():
        raise ShapeError(f"cam2_from_cam1 must be a single motion, got {cam2_from_cam1.batch_shape()}")
    rays1, rays2 = as_points(rays1, "rays1", 3), as_points(rays2, "rays2", 3)
    require_same_length(rays1=rays1, rays2=rays2)
    with np.errstate(invalid="ignore"):  # a zero ray gives NaN, too
        d1 = rays1 / np.linalg.norm(rays1, axis=-1, keepdims=True) @ cam2_from_cam1.rotation.T
        d2 = rays2 / np.linalg.norm(rays2, axis=-1, keepdims=True)
    t = cam2_from_cam1.translation
    normal = np.cross(d1, d2)
    sin_sq = (normal**2).sum(axis=-1)
    sin_sq = np.where(sin_sq > 1e-24, sin_sq, np.nan)
    along1 = (np.cross(d2, t) * normal).sum(axis=-1) / sin_sq
    along2 = (np.cross(d1, t) * normal).sum(axis=-1) / sin_sq
    middle = 0.5 * (along1[..., None] * d1 + t + along2[..., None] * d2)
    return cam2_from_cam1.inverse().apply(middle), along1, along2


def ray_angles_rad(points: Any, centers_a: Any, centers_b: Any) -> Float64[np.ndarray, "*batch"]:
    """Angle at each point between the rays to two camera centers: the triangulation (parallax) angle."""
    points = as_float_array(points, "points", 3)
    a, b = as_float_array(centers_a, "centers_a", 3), as_float_array(centers_b, "centers_b", 3)
    check_broadcast(points=points.shape, centers_a=a.shape, centers_b=b.shape)
    a, b = a - points, b - points
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1)))
