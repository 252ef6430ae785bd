"""Homographies that align the epipolar lines of two uncalibrated images with their rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, as_points, checked, require_same_length
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry.epipolar import epipoles
from epipole.geometry.homogeneous import from_homogeneous, to_homogeneous
from epipole.geometry.rotation3 import skew

Matrix3 = Float64[np.ndarray, "3 3"]


@checked
def rectifying_homographies(
    fundamental: Any, pixels1: Any, pixels2: Any, size: tuple[int, int]
) -> tuple[Matrix3, Matrix3]:
    """(H1, H2) after which matches lie in the same row, with the smallest disparities (Hartley, IJCV 1999; HZ 11.12).

    H2 rotates the second epipole about the image center onto the x axis and sends it to infinity, which moves the neighborhood of
    the center rigidly; H1 is the matching transformation with the smallest disparities.

    Args:
        fundamental: (3, 3), x2^T F x1 = 0.
        pixels1: matches in image 1, (n, 2), n >= 3.
        pixels2: the same in image 2.
        size: width and height of image 2.

    Raises:
        DegenerateGeometryError: an epipole lies in the image (forward motion), or the matches do not determine the shear.
        ShapeError: array sizes do not match.
    """
    F = as_float_array(fundamental, "fundamental", 3, 3, finite=True)
    x1, x2 = as_points(pixels1, "pixels1", 2, finite=True), as_points(pixels2, "pixels2", 2, finite=True)
    if require_same_length(pixels1=x1, pixels2=x2) < 3:
        raise ShapeError(f"at least 3 matches are needed, got {len(x1)}")
    width, height = size
    _, e2 = epipoles(F)
    if abs(e2[2]) * max(width, height) > 1e-9 * np.hypot(e2[0], e2[1]):
        u, v = e2[:2] / e2[2]
        if -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5:
            raise DegenerateGeometryError(
                "the epipole lies in the image (forward motion), so the pair cannot be rectified by homographies"
            )
    center = np.array([[1.0, 0.0, -(width - 1) / 2], [0.0, 1.0, -(height - 1) / 2], [0.0, 0.0, 1.0]])
    e = center @ e2
    # Rotate by less than 90 degrees, so that the image stays upright.
    length = np.hypot(e[0], e[1])
    cos, sin = (e[:2] if e[0] >= 0 else -e[:2]) / length
    rotation = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    along = rotation @ e
    to_infinity = np.eye(3)
    to_infinity[2, 0] = -along[2] / along[0]
    back = np.linalg.inv(center)
    H2 = back @ to_infinity @ rotation @ center
    # F = [e2]x M for M = [e2]x^T F + e2 w^T with any w; M brings image 1 next to image 2.
    M = skew(e2).T @ F
    M = M + np.outer(e2, [1.0, 1.0, 1.0]) * np.linalg.norm(M) / np.linalg.norm(np.outer(e2, [1.0, 1.0, 1.0]))
    H0 = H2 @ M
    if abs(np.linalg.det(H0)) < 1e-12 * np.linalg.norm(H0) ** 3:
        raise DegenerateGeometryError("the fundamental matrix has no matching transformation")
    moved1, moved2 = from_homogeneous(to_homogeneous(x1) @ H0.T), from_homogeneous(to_homogeneous(x2) @ H2.T)
    # The shear (a, b, c) of the row coordinate: a u + b v + c is closest to u2.
    system = to_homogeneous(moved1)
    if not np.isfinite(system).all() or not np.isfinite(moved2).all():
        raise DegenerateGeometryError("a match is mapped to infinity")
    shear, _, rank, _ = np.linalg.lstsq(system, moved2[:, 0], rcond=None)
    if rank < 3 or not np.isfinite(shear).all():
        raise DegenerateGeometryError("the matches are collinear, so the shear is undetermined")
    H1 = np.array([shear, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ H0
    return H1 / H1[2, 2], H2 / H2[2, 2]
