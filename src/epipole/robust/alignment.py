"""Robust alignment of two point sets: rigid motion, similarity, upright similarity."""

from __future__ import annotations

from typing import Any

import numpy as np

from epipole._checks import as_points, require_same_length
from epipole.config import RansacConfig, options_of
from epipole.geometry import Rigid3, Similarity3, skew
from epipole.robust._alignment_kernels import SCALE, AlignmentProblem, UprightAlignmentProblem
from epipole.robust.estimate import Estimate, Found, checked_quality, random_order, run_loop, usable_rows


def estimate_rigid(
    source: Any, target: Any, config: RansacConfig | None = None, *, quality: Any = None
) -> Estimate[Rigid3]:
    """The rigid motion that maps points to their partners: three points (Horn 1987), then truncated distances.

    Args:
        source: (n, 3); rows with NaN or infinity are outliers.
        target: (n, 3), in the same order.
        config: `max_error_px` is the largest distance, in the unit of the target.
        quality: (n,), higher is better (PROSAC).

    Returns:
        `model` = target_from_source; `covariance` (6, 6) of xi in exp(xi) @ target_from_source.

    Raises:
        ShapeError: array sizes do not match.
    """
    found = _fit(source, target, 6, options_of(RansacConfig, config), quality)
    motion = Rigid3(found.raw[:9].reshape(3, 3).copy(), found.raw[9:12].copy())
    return found.estimate(motion, _tangent_covariance(found))


def estimate_similarity(
    source: Any, target: Any, config: RansacConfig | None = None, *, quality: Any = None
) -> Estimate[Similarity3]:
    """The similarity that maps points to their partners; like `estimate_rigid`, with scale.

    Args:
        source: (n, 3); rows with NaN or infinity are outliers.
        target: (n, 3), in the same order.
        config: `max_error_px` is the largest distance, in the unit of the target.
        quality: (n,), higher is better (PROSAC).

    Returns:
        `model` = target_from_source; `covariance` (7, 7) of xi in exp(xi) @ target_from_source, with log scale last.

    Raises:
        ShapeError: array sizes do not match.
    """
    found = _fit(source, target, 7, options_of(RansacConfig, config), quality)
    return found.estimate(_similarity(found), _tangent_covariance(found))


def estimate_upright_similarity(
    source: Any, target: Any, config: RansacConfig | None = None
) -> Estimate[Similarity3]:
    """The similarity that keeps the z axis and maps points to their partners: two points, then truncated distances.

    For upright models: scale, heading and translation, which even a straight trajectory determines.

    Args:
        source: (n, 3); rows with NaN or infinity are outliers.
        target: (n, 3), in the same order.
        config: `max_error_px` is the largest distance, in the unit of the target.

    Returns:
        `model` = target_from_source; `covariance` (7, 7) of xi in exp(xi) @ target_from_source, of rank five, as there is no tilt.

    Raises:
        ShapeError: array sizes do not match.
    """
    config = options_of(RansacConfig, config)
    items, order, n = _matched(source, target, config)
    found = run_loop(UprightAlignmentProblem(items), order, n, 1.0, config, None)
    covariance = np.full((7, 7), np.inf)
    if np.isfinite(found.covariance).all():
        positions = np.eye(7)[:, [0, 1, 2, 5, 6]]
        covariance = positions @ found.covariance @ positions.T
    return found.estimate(_similarity(found), _lifted(covariance, found.raw[9:12]))


def _fit(source: Any, target: Any, freedom: int, config: RansacConfig, quality: Any) -> Found:
    items, order, n = _matched(source, target, config)
    return run_loop(AlignmentProblem(items, freedom), order, n, 1.0, config, checked_quality(quality, n))


def _matched(source: Any, target: Any, config: RansacConfig) -> tuple[np.ndarray, np.ndarray, int]:
    """Usable pairs of points as columns (6, m), their rows (m,) and the total number."""
    x, y = as_points(source, "source", 3), as_points(target, "target", 3)
    n = require_same_length(source=x, target=y)
    order = random_order(usable_rows(x, y), config)
    return np.ascontiguousarray(np.concatenate([x[order], y[order]], axis=1).T), order, n


def _similarity(found: Found) -> Similarity3:
    return Similarity3(found.raw[SCALE], found.raw[:9].reshape(3, 3).copy(), found.raw[9:12].copy())


def _tangent_covariance(found: Found) -> np.ndarray:
    return _lifted(found.covariance, found.raw[9:12])


def _lifted(covariance: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Covariance of (dt, phi, sigma) to that of xi in exp(xi) @ model: t + dt = t + rho + phi x t + sigma t."""
    freedom = len(covariance)
    if not (np.isfinite(covariance).all() and np.isfinite(t).all()):
        return np.full((freedom, freedom), np.inf)
    lift = np.eye(freedom)
    lift[:3, 3:6] = skew(t)
    if freedom == 7:
        lift[:3, 6] = -t
    return lift @ covariance @ lift.T
