"""Two-view solvers for callers with arrays; the robust loop uses the kernels directly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_points, as_table, require_same_length
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, from_homogeneous, to_homogeneous
from epipole.solvers import _five_point_kernels as five_point
from epipole.solvers import _focal_motion_kernels as focal_motion
from epipole.solvers import _more_pose_kernels as more
from epipole.solvers import _two_view_kernels as kernels


def solve_essential_five_point(rays1: Any, rays2: Any) -> Float64[np.ndarray, "k 3 3"]:
    """All essential matrices for five matches, y2^T E y1 = 0, |E| = 1 (Nister, PAMI 2004).

    Args:
        rays1: directions in camera 1, (5, 3), any length.
        rays2: the same in camera 2.

    Returns:
        Between 0 and 10 matrices; none for degenerate input.
    """
    y1, y2 = (
        as_table(rays1, "rays1", 5, 3),
        as_table(rays2, "rays2", 5, 3),
    )
    out = np.empty((10, 9))
    return out[: five_point.essential_five_point(y1, y2, out, five_point.five_point_workspace())].reshape(
        -1, 3, 3
    )


def solve_upright_relative_three_point(rays1: Any, rays2: Any) -> Rigid3:
    """All cam2_from_cam1, |t| = 1, for three matches between cameras with a common vertical y axis (Fraundorfer et al. 2010).

    Args:
        rays1: directions in camera 1, (3, 3), any length.
        rays2: the same in camera 2.

    Returns:
        Rigid3 of batch shape (k,): up to six rotations, each with both signs of t.
    """
    y1 = as_table(rays1, "rays1", 3, 3)
    y2 = as_table(rays2, "rays2", 3, 3)
    out = np.empty((12, 12))
    count = more.upright_relative_three_point(y1, y2, out, more.upright_relative_workspace())
    return Rigid3(out[:count, :9].reshape(-1, 3, 3).copy(), out[:count, 9:].copy())


@dataclass(frozen=True, slots=True, eq=False)
class SharedFocals:
    """Fundamental matrices, |F| = 1, with the shared focal length of both cameras, in pixels."""

    fundamental: Float64[np.ndarray, "k 3 3"]
    focal_px: Float64[np.ndarray, " k"]


def solve_shared_focal_six_point(pixels1: Any, pixels2: Any) -> SharedFocals:
    """All fundamental matrices for six matches between two cameras with one focal length (Stewenius et al. 2005).

    Assumes square pixels, no distortion, and a focal length from a quarter to eight times the extent of the images.

    Args:
        pixels1: relative to the principal point, (6, 2).
        pixels2: the same in image 2.

    Returns:
        Between 0 and 8 solutions; none if the optical axes intersect, as the focal length is then undetermined.
    """
    p1 = as_table(pixels1, "pixels1", 6, 2)
    p2 = as_table(pixels2, "pixels2", 6, 2)
    size = max(float(np.abs(p1).max()), float(np.abs(p2).max())) or 1.0
    x1, x2 = to_homogeneous(p1 / size), to_homogeneous(p2 / size)
    essentials, focals = np.empty((8, 9)), np.empty(8)
    count = focal_motion.shared_focal_six_point(
        x1, x2, essentials, focals, focal_motion.shared_focal_workspace()
    )
    focal_px = size * focals[:count]
    camera = np.ones((count, 3))
    camera[:, 2] = focal_px
    found = camera[:, :, None] * essentials[:count].reshape(-1, 3, 3) * camera[:, None, :]
    return SharedFocals(found / np.linalg.norm(found, axis=(1, 2), keepdims=True), focal_px)


def solve_fundamental_seven_point(pixels1: Any, pixels2: Any) -> Float64[np.ndarray, "k 3 3"]:
    """The one to three fundamental matrices for seven matches (HZ section 11.1.2), |F| = 1.

    Args:
        pixels1: (7, 2).
        pixels2: (7, 2).
    """
    p1 = as_table(pixels1, "pixels1", 7, 2)
    p2 = as_table(pixels2, "pixels2", 7, 2)
    t1, t2 = hartley_normalization(p1), hartley_normalization(p2)
    out = np.empty((3, 9))
    x1, x2 = to_homogeneous(p1) @ t1.T, to_homogeneous(p2) @ t2.T
    count = kernels.fundamental_seven_point(x1, x2, out, kernels.seven_point_workspace())
    found = t2.T @ out[:count].reshape(-1, 3, 3) @ t1
    return found / np.linalg.norm(found, axis=(1, 2), keepdims=True)


def solve_fundamental_eight_point(pixels1: Any, pixels2: Any) -> Float64[np.ndarray, "3 3"]:
    """The least-squares fundamental matrix of n >= 8 matches, normalized (Hartley, PAMI 1997), |F| = 1, rank 2.

    Raises:
        DegenerateGeometryError: the solution is not unique (a plane, a rotation, coincident points).
    """
    p1, p2 = _matched(pixels1, pixels2, 8)
    t1, t2 = hartley_normalization(p1), hartley_normalization(p2)
    x1, x2 = to_homogeneous(p1) @ t1.T, to_homogeneous(p2) @ t2.T
    f = _null_vector((x2[:, :, None] * x1[:, None, :]).reshape(-1, 9)).reshape(3, 3)
    u, s, vt = np.linalg.svd(f)
    f = t2.T @ (u * [s[0], s[1], 0.0]) @ vt @ t1
    return f / np.linalg.norm(f)


def solve_homography_four_point(pixels1: Any, pixels2: Any) -> Float64[np.ndarray, "k 3 3"]:
    """The homography for four matches, x2 ~ H x1, |H| = 1: one, or none if three points are collinear."""
    p1 = as_table(pixels1, "pixels1", 4, 2)
    p2 = as_table(pixels2, "pixels2", 4, 2)
    t1, t2 = hartley_normalization(p1), hartley_normalization(p2)
    out = np.empty(9)
    if not kernels.homography_four_point(to_homogeneous(p1) @ t1.T, to_homogeneous(p2) @ t2.T, out):
        return np.empty((0, 3, 3))
    h = np.linalg.solve(t2, out.reshape(3, 3) @ t1)
    return h[None] / np.linalg.norm(h)


def solve_homography_dlt(pixels1: Any, pixels2: Any) -> Float64[np.ndarray, "3 3"]:
    """The direct linear transform of n >= 4 matches, x2 ~ H x1, normalized (HZ algorithm 4.2), |H| = 1.

    Raises:
        DegenerateGeometryError: the points do not determine a homography.
    """
    p1, p2 = _matched(pixels1, pixels2, 4)
    t1, t2 = hartley_normalization(p1), hartley_normalization(p2)
    x1, q2 = to_homogeneous(p1) @ t1.T, from_homogeneous(to_homogeneous(p2) @ t2.T)
    zero = np.zeros_like(x1)
    rows_u = np.concatenate([x1, zero, -q2[:, :1] * x1], axis=1)
    rows_v = np.concatenate([zero, x1, -q2[:, 1:] * x1], axis=1)
    h = _null_vector(np.concatenate([rows_u, rows_v])).reshape(3, 3)
    h = np.linalg.solve(t2, h @ t1)
    return h / np.linalg.norm(h)


def hartley_normalization(pixels: Any) -> Float64[np.ndarray, "3 3"]:
    """T such that T x has mean zero and mean distance sqrt(2) (Hartley, PAMI 1997).

    Raises:
        DegenerateGeometryError: all points coincide.
    """
    points = as_points(pixels, "pixels", 2, finite=True)
    center = points.mean(axis=0)
    spread = np.linalg.norm(points - center, axis=1).mean()
    if not spread > 0:
        raise DegenerateGeometryError("all points coincide")
    scale = np.sqrt(2.0) / spread
    return np.array([[scale, 0, -scale * center[0]], [0, scale, -scale * center[1]], [0, 0, 1]])


def _matched(pixels1: Any, pixels2: Any, least: int) -> tuple[np.ndarray, np.ndarray]:
    p1, p2 = as_points(pixels1, "pixels1", 2, finite=True), as_points(pixels2, "pixels2", 2, finite=True)
    if require_same_length(pixels1=p1, pixels2=p2) < least:
        raise ShapeError(f"at least {least} matches are needed, got {len(p1)}")
    return p1, p2


def _null_vector(system: np.ndarray) -> np.ndarray:
    """The right singular vector of the smallest singular value.

    With fewer rows than columns, the economy-size SVD omits it; with more, the full SVD would compute n x n left vectors.
    """
    if not np.isfinite(system).all():
        raise ShapeError("the pixels have values that are too large")
    _, s, vt = np.linalg.svd(system, full_matrices=len(system) < system.shape[1])
    if len(s) >= 8 and s[7] <= 1e-9 * s[0]:
        raise DegenerateGeometryError("the matches do not determine a unique solution")
    return vt[-1]
