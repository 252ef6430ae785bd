"""Two-view algebra: essential and fundamental matrices, epipolar lines, epipoles and decomposition.

Convention: x2^T F x1 = 0 for pixels, y2^T E y1 = 0 for rays, E = [t]x R with cam2_from_cam1 = (R, t).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import as_float_array, as_points, check_broadcast, checked, require_same_length
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry.homogeneous import normalize_lines, to_homogeneous
from epipole.geometry.rigid3 import Rigid3
from epipole.geometry.rotation3 import skew
from epipole.geometry.triangulation import triangulate_two_view


@checked
def essential_from_cam2_from_cam1(cam2_from_cam1: Rigid3) -> Float64[np.ndarray, "*batch 3 3"]:
    """E = [t]x R (Longuet-Higgins 1981). Zero translation gives the zero matrix: there is no epipolar geometry."""
    return skew(cam2_from_cam1.translation) @ cam2_from_cam1.rotation


def fundamental_from_essential(essential: Any, K1: Any, K2: Any) -> Float64[np.ndarray, "*batch 3 3"]:
    """F = K2^-T E K1^-1 (Luong and Faugeras 1996).

    Raises:
        DegenerateGeometryError: a calibration matrix is singular.
        ShapeError: array sizes do not match.
    """
    K1, K2 = as_float_array(K1, "K1", 3, 3), as_float_array(K2, "K2", 3, 3)
    essential = as_float_array(essential, "essential", 3, 3)
    check_broadcast(essential=essential.shape, K1=K1.shape, K2=K2.shape)
    return np.swapaxes(_inverse(K2, "K2"), -1, -2) @ essential @ _inverse(K1, "K1")


def essential_from_fundamental(fundamental: Any, K1: Any, K2: Any) -> Float64[np.ndarray, "*batch 3 3"]:
    """E = K2^T F K1."""
    K1, K2 = as_float_array(K1, "K1", 3, 3), as_float_array(K2, "K2", 3, 3)
    fundamental = as_float_array(fundamental, "fundamental", 3, 3)
    check_broadcast(fundamental=fundamental.shape, K1=K1.shape, K2=K2.shape)
    return np.swapaxes(K2, -1, -2) @ fundamental @ K1


def epipolar_lines(fundamental: Any, pixels1: Any) -> Float64[np.ndarray, "n 3"]:
    """The epipolar lines F x1 in image 2 of pixels (n, 2) in image 1, scaled to unit normals."""
    points = to_homogeneous(as_points(pixels1, "pixels1", 2))
    return normalize_lines(points @ _single_matrix(fundamental, "fundamental").T)


def epipoles(fundamental: Any) -> tuple[Float64[np.ndarray, 3], Float64[np.ndarray, 3]]:
    """(e1, e2) with F e1 = 0 and F^T e2 = 0, as unit homogeneous vectors: images of the other camera's center."""
    u, _, vt = np.linalg.svd(_single_matrix(fundamental, "fundamental", finite=True))
    return vt[2], u[:, 2]


def sampson_error(fundamental: Any, pixels1: Any, pixels2: Any) -> Float64[np.ndarray, " n"]:
    """First-order distance of matches from the epipolar constraint, in pixels (Sampson 1982; HZ eq. 11.9)."""
    F = _single_matrix(fundamental, "fundamental")
    x1 = to_homogeneous(as_points(pixels1, "pixels1", 2))
    x2 = to_homogeneous(as_points(pixels2, "pixels2", 2))
    require_same_length(pixels1=x1, pixels2=x2)
    line2, line1 = x1 @ F.T, x2 @ F
    residual = (x2 * line2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.abs(residual) / np.sqrt((line2[:, :2] ** 2).sum(axis=1) + (line1[:, :2] ** 2).sum(axis=1))


def decompose_essential_matrix(essential: Any) -> Rigid3:
    """The four candidates cam2_from_cam1, |t| = 1: two rotations times two signs of t (HZ result 9.19).

    Returns:
        Rigid3 with batch shape (4,). The length of t cannot be determined from E.
    """
    u, _, vt = np.linalg.svd(_single_matrix(essential, "essential", finite=True))
    u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
    w = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    ra, rb, t = u @ w @ vt, u @ w.T @ vt, u[:, 2]
    return Rigid3(np.stack([ra, ra, rb, rb]), np.stack([t, -t, t, -t]))


@checked
def choose_by_cheirality(
    candidates: Rigid3, rays1: Any, rays2: Any
) -> tuple[int, Bool[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """Choose the candidate that puts most points in front of both cameras.

    Args:
        candidates: cam2_from_cam1, batch shape (m,).
        rays1: matched directions in camera 1, (n, 3), any length.
        rays2: the same in camera 2.

    Returns:
        Index of the best candidate, mask of the points in front of both cameras, points in camera 1.
    """
    if len(candidates.batch_shape()) != 1:
        raise ShapeError(f"candidates must have a batch of one axis, got {candidates.batch_shape()}")
    rays1, rays2 = as_points(rays1, "rays1", 3), as_points(rays2, "rays2", 3)
    require_same_length(rays1=rays1, rays2=rays2)
    best = (-1, np.zeros(len(rays1), bool), np.full((len(rays1), 3), np.nan))
    for index in range(len(candidates)):
        points, depth1, depth2 = triangulate_two_view(candidates[index], rays1, rays2)
        in_front = (depth1 > 0) & (depth2 > 0)
        if best[0] < 0 or in_front.sum() > best[1].sum():
            best = (index, in_front, points)
    return best


def _inverse(matrix: np.ndarray, name: str) -> np.ndarray:
    try:
        return np.linalg.inv(matrix)
    except np.linalg.LinAlgError as error:
        raise DegenerateGeometryError(f"{name} is singular") from error


def _single_matrix(matrix: Any, name: str, *, finite: bool = False) -> np.ndarray:
    """A single 3x3 matrix; batches are rejected, as they would be misinterpreted."""
    out = as_float_array(matrix, name, 3, 3, finite=finite)
    if out.ndim != 2:
        raise ShapeError(f"{name} must be one (3, 3) matrix, got {out.shape}")
    return out
