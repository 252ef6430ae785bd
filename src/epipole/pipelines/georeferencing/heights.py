"""Heights above different surfaces: survey heights are above the ellipsoid or above sea level (the geoid), up to 107 m apart.

Points mixed from both fit the model in their horizontal coordinates, and differ in height by a constant.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64

from epipole.errors import DegenerateGeometryError
from epipole.geometry import align_points

LEAST_M, MOST_M = 3.0, 110.0
"""Constant differences of height that two surfaces explain."""
SAME = 0.1
"""Largest deviation from the constant, relative to it."""
MOST_POINTS = 12
"""More points are not searched."""
SURFACES = "they are probably above different surfaces, one above the ellipsoid and the other above sea level (the geoid)"


def common_height_m(differences_m: Float64[np.ndarray, " n"]) -> float | None:
    """The constant that two or more differences of height share, if two surfaces explain it; else None."""
    if len(differences_m) < 2:
        return None
    middle = float(np.median(differences_m))
    near = np.abs(differences_m - middle) <= SAME * abs(middle)
    return middle if near.all() and LEAST_M <= abs(middle) <= MOST_M else None


def mixed_heights(
    source: Float64[np.ndarray, "n 3"], target: Float64[np.ndarray, "n 3"], tolerance_m: float
) -> tuple[Bool[np.ndarray, " n"], float] | None:
    """Points whose heights are above another surface than those of three others, and by how much they are higher; None if heights are not mixed.

    Every three points give a similarity. With it, all points must fit horizontally, and those that do not fit in height must differ by a constant.

    Args:
        source: points in the model's coordinates.
        target: the same points, east, north and up.
        tolerance_m: largest distance of a point that fits.
    """
    if not 5 <= len(source) <= MOST_POINTS:
        return None
    for three in map(list, combinations(range(len(source)), 3)):
        try:
            fitted = align_points(source[three], target[three])
        except DegenerateGeometryError:
            continue
        off = target - fitted.apply(source)
        higher = np.abs(off[:, 2]) > tolerance_m
        if higher[three].any() or not (np.linalg.norm(off[:, :2], axis=1) <= tolerance_m).all():
            continue
        constant = common_height_m(off[higher, 2])
        if constant is not None:
            return higher, constant
    return None
