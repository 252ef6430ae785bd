"""Triangulation: where back-projected rays meet."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, as_points, require_same_length
from epipole.geometry.rigid3 import Rigid3


def triangulate_linear(cams_from_world: Rigid3, rays: Any) -> Float64[np.ndarray, 3]:
    """The point nearest to n >= 2 rays in the DLT sense (HZ section 12.2, on unit rays).

    Each view contributes [d]x (R X + t) = 0; the homogeneous system is solved by SVD, so that a point at
    infinity is found too and returned as non-finite coordinates.

    Args:
        cams_from_world: batch shape (n,).
        rays: directions in each camera, (n, 3), any length.
    """
    rays = as_points(rays, "rays", 3, finite=True)
    require_same_length(cams_from_world=cams_from_world.translation, rays=rays)
    d = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    # The component of R X + t orthogonal to d vanishes: (I - d d^T) [R t] X = 0.
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    scale = np.abs(cams_from_world.translation).max() or 1.0
    system = across @ np.concatenate(
        [cams_from_world.rotation, cams_from_world.translation[:, :, None] / scale], axis=2
    )
    _, _, vt = np.linalg.svd(system.reshape(-1, 4))
    with np.errstate(divide="ignore", invalid="ignore"):
        return scale * vt[3, :3] / vt[3, 3]


def triangulate_two_view(
    cam2_from_cam1: Rigid3, rays1: Any, rays2: Any
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Midpoints of the shortest segments between matched rays, with the depths along both.

    Solves min |a R d1 + t - b d2| for each match (2x2 normal equations). Parallel rays give NaN.

    Args:
        cam2_from_cam1: a single motion.
        rays1: directions in camera 1, (n, 3), any length.
        rays2: the same in camera 2.

    Returns:
        Points in camera 1; distance along ray 1; distance along ray 2 (negative: behind).
    """
    rays1, rays2 = as_float_array(rays1, "rays1", 3), as_float_array(rays2, "rays2", 3)
    d1 = rays1 / np.linalg.norm(rays1, axis=-1, keepdims=True) @ cam2_from_cam1.rotation.T
    d2 = rays2 / np.linalg.norm(rays2, axis=-1, keepdims=True)
    t = cam2_from_cam1.translation
    cos = (d1 * d2).sum(axis=-1)
    sin_sq = 1.0 - cos * cos
    with np.errstate(divide="ignore", invalid="ignore"):
        sin_sq = np.where(sin_sq > 1e-16, sin_sq, np.nan)
        along1 = (cos * (d2 @ t) - d1 @ t) / sin_sq
        along2 = (d2 @ t - cos * (d1 @ t)) / sin_sq
    middle = 0.5 * (along1[..., None] * d1 + t + along2[..., None] * d2)
    return cam2_from_cam1.inverse().apply(middle), along1, along2


def ray_angles_rad(points: Any, centers_a: Any, centers_b: Any) -> Float64[np.ndarray, "*batch"]:
    """Angle at each point between the rays to two camera centres: the triangulation (parallax) angle."""
    points = as_float_array(points, "points", 3)
    a, b = (
        as_float_array(centers_a, "centers_a", 3) - points,
        as_float_array(centers_b, "centers_b", 3) - points,
    )
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))
