"""Homogeneous points and lines: a point x lies on a line l if and only if l . x = 0."""

from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, check_broadcast
from epipole.errors import ShapeError


def to_homogeneous(points: Any) -> Float64[np.ndarray, "*batch m"]:
    """Append a 1: (u, v) -> (u, v, 1)."""
    points = _with_axis(points)
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def from_homogeneous(points: Any) -> Float64[np.ndarray, "*batch m"]:
    """Divide by the last coordinate and drop it; points at infinity become non-finite."""
    points = _with_axis(points)
    with np.errstate(divide="ignore", invalid="ignore"):
        return points[..., :-1] / points[..., -1:]


def line_through(points_a: Any, points_b: Any) -> Float64[np.ndarray, "*batch 3"]:
    """The line a x b through two image points (..., 2), scaled so that |(a, b)| = 1 (distances in pixels).

    Coinciding points have no line: NaN.
    """
    a, b = as_float_array(points_a, "points_a", 2), as_float_array(points_b, "points_b", 2)
    check_broadcast(points_a=a.shape[:-1], points_b=b.shape[:-1])
    return normalize_lines(np.cross(to_homogeneous(a), to_homogeneous(b)))


def normalize_lines(lines: Any) -> Float64[np.ndarray, "*batch 3"]:
    """Scale lines (a, b, c) to a^2 + b^2 = 1, so that l . (u, v, 1) is a signed distance."""
    lines = as_float_array(lines, "lines", 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        return lines / np.linalg.norm(lines[..., :2], axis=-1, keepdims=True)


def intersection_of(lines_a: Any, lines_b: Any) -> Float64[np.ndarray, "*batch 2"]:
    """The intersection of two lines; parallel lines give non-finite coordinates."""
    a, b = as_float_array(lines_a, "lines_a", 3), as_float_array(lines_b, "lines_b", 3)
    check_broadcast(lines_a=a.shape[:-1], lines_b=b.shape[:-1])
    return from_homogeneous(np.cross(a, b))


def point_line_distance(points: Any, lines: Any) -> Float64[np.ndarray, "*batch"]:
    """Distance of image points (..., 2) from lines (..., 3), in the unit of the points."""
    points, lines = as_float_array(points, "points", 2), as_float_array(lines, "lines", 3)
    check_broadcast(points=points.shape[:-1], lines=lines.shape[:-1])
    return np.asarray(np.abs((to_homogeneous(points) * normalize_lines(lines)).sum(axis=-1)))


def _with_axis(points: Any) -> np.ndarray:
    """Points with at least one axis, that of their coordinates."""
    out = as_float_array(points, "points")
    if out.shape[-1] == 0:
        raise ShapeError(f"points must have coordinates, got {out.shape}")
    return out
