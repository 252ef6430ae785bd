"""The similarity that best maps one set of points onto another."""

from __future__ import annotations

from typing import Any

import numpy as np

from epipole._checks import as_points, checked, require_same_length
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry.similarity3 import Similarity3


@checked
def align_points(source: Any, target: Any, *, with_scale: bool = True) -> Similarity3:
    """target_from_source minimizing sum |target - (s R source + t)|^2 (Umeyama, PAMI 1991, eqs. 40-42).

    Args:
        source: (n, 3).
        target: (n, 3), in the same order.
        with_scale: whether to estimate s; False fixes s = 1.

    Raises:
        DegenerateGeometryError: fewer than three points, or collinear points (the rotation is then undetermined).
        ShapeError: array sizes do not match.
    """
    source, target = as_points(source, "source", 3, finite=True), as_points(target, "target", 3, finite=True)
    if require_same_length(source=source, target=target) < 3:
        raise DegenerateGeometryError(f"alignment needs at least 3 points, got {len(source)}")
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    a, b = source - mean_source, target - mean_target
    covariance = b.T @ a / len(a)
    if not np.isfinite(covariance).all():
        raise ShapeError("source or target has values too large to be squared")
    u, singular, vt = np.linalg.svd(covariance)
    if singular[1] <= 1e-12 * max(singular[0], 1e-300):
        raise DegenerateGeometryError(
            "the points are collinear (or coincide), so the rotation is undetermined"
        )
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((singular * sign).sum() / (a**2).sum(axis=1).mean()) if with_scale else 1.0
    return Similarity3(np.asarray(scale), rotation, mean_target - scale * rotation @ mean_source)
