"""Camera motion and plane normal from a homography between two calibrated images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, as_points
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry.homogeneous import to_homogeneous
from epipole.geometry.rigid3 import Rigid3

ROTATION_SPREAD = 1e-9
"""Relative spread of the singular values below which a homography is a rotation."""


@dataclass(frozen=True, slots=True, eq=False)
class PlaneMotions:
    """Motions and normals with K2 (R + t n^T) K1^-1 ~ H; the plane is n . X = 1 in camera 1."""

    cam2_from_cam1: Rigid3
    """Batch (k,); translations in units of the plane's distance from camera 1; 0 for a pure rotation."""
    normals_in_cam1: Float64[np.ndarray, "k 3"]
    """Unit, toward the plane; NaN for a pure rotation."""

    def __len__(self) -> int:
        return len(self.normals_in_cam1)

    def __repr__(self) -> str:
        return f"PlaneMotions({len(self)} solutions)"


def decompose_homography(homography: Any, K1: Any, K2: Any, pixels1: Any = None) -> PlaneMotions:
    """The motions that are consistent with a homography x2 ~ H x1: up to four, or two if points on the plane are known.

    The singular value decomposition of H = R + t n^T, scaled to a middle singular value of one (Faugeras and Lustman
    1988; Ma, Soatto, Kosecka and Sastry 2004, section 5.3).

    Args:
        homography: (3, 3), at any scale.
        K1: intrinsics of image 1, (3, 3).
        K2: intrinsics of image 2, (3, 3).
        pixels1: (n, 2) on the plane; solutions with one of them behind camera 1 are dropped.

    Raises:
        DegenerateGeometryError: H is singular (the plane is seen edge-on), or K1 or K2 is.
        ShapeError: H, K1 or K2 is not one finite matrix.
    """
    H = as_float_array(homography, "homography", 3, 3, finite=True)
    if H.ndim != 2:
        raise ShapeError(f"homography must be one (3, 3) matrix, got {H.shape}")
    K1, K2 = as_float_array(K1, "K1", 3, 3, finite=True), as_float_array(K2, "K2", 3, 3, finite=True)
    if K1.ndim != 2 or K2.ndim != 2:
        raise ShapeError(f"K1 and K2 must be one (3, 3) matrix each, got {K1.shape} and {K2.shape}")
    if not max(np.linalg.cond(K1), np.linalg.cond(K2)) < 1e15:
        raise DegenerateGeometryError("K1 or K2 is singular")
    G = np.linalg.solve(K2, H @ K1)
    if not np.isfinite(G).all():
        raise ShapeError("homography, K1 or K2 has values that are too large")
    singular = np.linalg.svd(G, compute_uv=False)
    if not singular[2] > 1e-12 * singular[0]:
        raise DegenerateGeometryError("the homography is singular")
    G = G / singular[1]
    if np.linalg.det(G) < 0:  # a plane in front of both cameras keeps its orientation
        G = -G
    values, vectors = np.linalg.eigh(G.T @ G)
    low, high = values[0], values[2]
    if high - low < ROTATION_SPREAD:
        u, _, vt = np.linalg.svd(G)
        return PlaneMotions(Rigid3((u @ vt)[None], np.zeros((1, 3))), np.full((1, 3), np.nan))
    v1, v2, v3 = vectors[:, 2], vectors[:, 1], vectors[:, 0]
    spread = np.sqrt(high - low)
    a, b = np.sqrt(max(1.0 - low, 0.0)) / spread, np.sqrt(max(high - 1.0, 0.0)) / spread
    rotations, translations, normals = [], [], []
    for sign in (1.0, -1.0):
        in_plane = a * v1 + sign * b * v3
        n = np.cross(v2, in_plane)
        U = np.stack([v2, in_plane, n], axis=1)
        W = np.stack([G @ v2, G @ in_plane, np.cross(G @ v2, G @ in_plane)], axis=1)
        R = W @ U.T
        t = (G - R) @ n
        for side in (1.0, -1.0):
            rotations.append(R)
            translations.append(side * t)
            normals.append(side * n)
    motions = Rigid3(np.stack(rotations), np.stack(translations))
    found = np.stack(normals)
    if pixels1 is not None:
        rays = to_homogeneous(as_points(pixels1, "pixels1", 2, finite=True)) @ np.linalg.inv(K1).T
        before = (rays @ found.T > 0).all(axis=0)
        motions, found = motions[before], found[before]
    return PlaneMotions(motions, found)
