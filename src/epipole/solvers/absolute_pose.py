"""Camera pose from minimal and larger sets of points, for callers with arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_directions, as_points, as_table, require_same_length
from epipole._damped import minimize
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3, skew
from epipole.solvers import _absolute_pose_kernels as kernels
from epipole.solvers import _more_pose_kernels as more


def solve_p3p(points_in_world: Any, rays_in_cam: Any) -> Rigid3:
    """All cam_from_world for three points, s_i y_i = R X_i + t with s_i > 0 (Ding et al., CVPR 2023).

    Args:
        points_in_world: (3, 3), not collinear.
        rays_in_cam: directions, (3, 3), any length.

    Returns:
        Rigid3 of batch shape (k,), k between 0 and 4.
    """
    rays = as_directions(as_table(rays_in_cam, "rays_in_cam", 3, 3), "rays_in_cam")
    points = as_table(points_in_world, "points_in_world", 3, 3)
    out = np.empty((4, 12))
    found = out[: kernels.p3p(rays, points, out, kernels.p3p_workspace())]
    return Rigid3(found[:, :9].reshape(-1, 3, 3).copy(), found[:, 9:].copy())


@dataclass(frozen=True, slots=True, eq=False)
class FocalPoses:
    """Poses with the focal length of each, in pixels."""

    cam_from_world: Rigid3
    focal_px: Float64[np.ndarray, " k"]


def solve_p4pf(points_in_world: Any, pixels: Any) -> FocalPoses:
    """All poses and focal lengths for four points (P4Pf: Bujnak, Kukelova and Pajdla, CVPR 2008; by three quadrics).

    Assumes square pixels, no distortion, and non-coplanar points.

    Args:
        points_in_world: (4, 3).
        pixels: relative to the principal point, (4, 2).

    Returns:
        Between 0 and 8 solutions; four points give one constraint more than there are unknowns, which is not used.
    """
    p = as_table(pixels, "pixels", 4, 2)
    points = as_table(points_in_world, "points_in_world", 4, 3)
    middle = points.mean(axis=0)
    size, spread = float(np.abs(points - middle).max()) or 1.0, float(np.abs(p).max()) or 1.0
    out = np.empty((8, 13))
    found = out[: more.p4pf(p / spread, (points - middle) / size, out, more.p4pf_workspace())]
    rotation = found[:, :9].reshape(-1, 3, 3).copy()
    return FocalPoses(Rigid3(rotation, size * found[:, 9:12] - rotation @ middle), spread * found[:, 12])


def solve_generalized_p3p(points_in_world: Any, origins_in_rig: Any, rays_in_rig: Any) -> Rigid3:
    """All rig_from_world for three rays of one or several cameras (gP3P), o_i + s_i y_i = R X_i + t with s_i > 0.

    Args:
        points_in_world: (3, 3), not collinear.
        origins_in_rig: origins of the rays, (3, 3).
        rays_in_rig: directions, (3, 3), any length; no two orthogonal.

    Returns:
        Rigid3 of batch shape (k,), k between 0 and 8.
    """
    origins = as_table(origins_in_rig, "origins_in_rig", 3, 3)
    rays = as_directions(as_table(rays_in_rig, "rays_in_rig", 3, 3), "rays_in_rig")
    points = as_table(points_in_world, "points_in_world", 3, 3)
    middle = points.mean(axis=0)
    size = float(np.abs(points - middle).max()) or 1.0
    out = np.empty((8, 13))
    scaled = (points - middle) / size
    found = out[: more.generalized_p3p(origins / size, rays, scaled, out, more.generalized_p3p_workspace())]
    rotation = found[:, :9].reshape(-1, 3, 3).copy()
    return Rigid3(rotation, size * found[:, 9:12] - rotation @ middle)


def solve_upright_p2p(points_in_world: Any, rays_in_cam: Any) -> Rigid3:
    """All cam_from_world for two points, for a camera with the world's y axis (Kukelova et al., ACCV 2010).

    Args:
        points_in_world: (2, 3), not vertically aligned.
        rays_in_cam: directions, (2, 3), any length; at least one not horizontal.

    Returns:
        Rigid3 of batch shape (k,), k between 0 and 2.
    """
    rays = as_directions(as_table(rays_in_cam, "rays_in_cam", 2, 3), "rays_in_cam")
    points = as_table(points_in_world, "points_in_world", 2, 3)
    out = np.empty((2, 12))
    found = out[: more.upright_p2p(rays, points, out)]
    return Rigid3(found[:, :9].reshape(-1, 3, 3).copy(), found[:, 9:].copy())


def solve_pnp(points_in_world: Any, rays_in_cam: Any) -> Rigid3:
    """The pose from n >= 4 points without outliers, by least squares in the distances of the points from their rays.

    With Q = I - y y^T the translation follows from the rotation, and the cost is r^T Omega r in the nine entries r of R (Terzakis
    and Lourakis, ECCV 2020). Its lowest eigenvectors, projected to the nearest rotations, are the starts of Gauss-Newton on
    SO(3); the best result wins.

    Args:
        points_in_world: (n, 3).
        rays_in_cam: directions, (n, 3), any length.

    Returns:
        cam_from_world.

    Raises:
        DegenerateGeometryError: the points do not determine a pose (collinear, coincident).
        ShapeError: fewer than four points, or array sizes do not match.
    """
    rays = as_points(rays_in_cam, "rays_in_cam", 3, finite=True)
    points = as_points(points_in_world, "points_in_world", 3, finite=True)
    if require_same_length(rays_in_cam=rays, points_in_world=points) < 4:
        raise ShapeError(f"at least 4 points are needed, got {len(points)}")
    middle = points.mean(axis=0)
    size = float(np.linalg.norm(points - middle, axis=1).max())
    if not size < np.inf:
        raise ShapeError("points_in_world has values that are too large")
    if not size > 0 or np.linalg.svd(points - middle, compute_uv=False)[1] < 1e-9 * size:
        raise DegenerateGeometryError("the points are collinear (or coincide)")
    x = (points - middle) / size
    y = as_directions(rays, "rays_in_cam")
    across = np.eye(3) - y[:, :, None] * y[:, None, :]
    moved = np.einsum("ij,nk->nijk", np.eye(3), x).reshape(-1, 3, 9)  # R x = moved r
    total = across.sum(axis=0)
    if np.linalg.cond(total) > 1e12:
        raise DegenerateGeometryError("all rays are parallel")
    to_translation = -np.linalg.solve(total, np.einsum("nij,njk->ik", across, moved))
    residual = across @ (moved + to_translation)
    omega = np.einsum("nij,nik->jk", residual, residual)
    _, vectors = np.linalg.eigh(omega)
    best: tuple[float, np.ndarray] = (np.inf, np.eye(3))
    for k in range(4):
        for sign in (1.0, -1.0):
            rotation = Rotation3.nearest(sign * vectors[:, k].reshape(3, 3)).matrix
            rotation = _descend(omega, rotation)
            translation = to_translation @ rotation.ravel()
            if ((x @ rotation.T + translation) * y).sum() <= 0:  # behind the camera
                continue
            cost = float(rotation.ravel() @ omega @ rotation.ravel())
            if cost < best[0]:
                best = (cost, rotation)
    if not np.isfinite(best[0]):
        raise DegenerateGeometryError("every solution puts the points behind the camera")
    rotation = best[1]
    return Rigid3(rotation, size * (to_translation @ rotation.ravel()) - rotation @ middle)


def _descend(omega: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Levenberg-Marquardt on r^T Omega r with steps exp(phi) R."""

    def cost(rotation: np.ndarray) -> float:
        return float(rotation.ravel() @ omega @ rotation.ravel())

    def linearize(rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        tangent = np.stack([(skew(axis) @ rotation).ravel() for axis in np.eye(3)], axis=1)
        return tangent.T @ omega @ tangent, tangent.T @ omega @ rotation.ravel()

    def step(rotation: np.ndarray, equations: tuple[np.ndarray, np.ndarray], damping: float) -> np.ndarray:
        curvature, gradient = equations
        damped = curvature + (damping * np.trace(curvature) + 1e-300) * np.eye(3)
        return Rotation3.exp(-np.linalg.solve(damped, gradient)).matrix @ rotation

    return minimize(rotation, cost, linearize, step, damping=1e-6, tolerance=1e-14, max_steps=50)
