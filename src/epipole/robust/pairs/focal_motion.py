"""Robust relative pose of two cameras with unknown focal lengths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from epipole._checks import as_float_array, as_points, require_same_length
from epipole.config import RansacConfig, options_of
from epipole.geometry import Rigid3
from epipole.robust.estimate import Estimate, random_order, run_loop, usable_rows
from epipole.robust.pairs._focal_motion_kernels import FOCAL1, FOCAL2, SharedFocalProblem, TwoFocalsProblem


@dataclass(frozen=True, slots=True, eq=False)
class FocalMotion:
    """Relative pose of two cameras, and their focal lengths."""

    cam2_from_cam1: Rigid3
    """|t| = 1."""
    focal1_px: float
    focal2_px: float


def estimate_motion_and_shared_focal(
    pixels1: Any, pixels2: Any, principal_point: Any, config: RansacConfig | None = None
) -> Estimate[FocalMotion]:
    """Relative pose and a shared focal length of two cameras: six points, then truncated Sampson error.

    If the optical axes intersect (a turntable, a camera circling an object), the focal length is undetermined or nearly so:
    check the covariance. The search covers focal lengths from a quarter to eight times the typical distance of the matches
    from the principal point.

    Args:
        pixels1: matches in image 1, (n, 2); rows with NaN or infinity are outliers.
        pixels2: the same in image 2.
        principal_point: (2,), of both images; their center if nothing better is known.
        config: threshold in pixels.

    Returns:
        `covariance` (6, 6) of the rotation from the left (3), the step of t in its tangent plane (2) and the log focal
        length.

    Raises:
        ShapeError: array sizes do not match.
    """
    return _fit(
        SharedFocalProblem,
        pixels1,
        pixels2,
        principal_point,
        principal_point,
        options_of(RansacConfig, config),
    )


def estimate_motion_and_focals(
    pixels1: Any,
    pixels2: Any,
    principal_point1: Any,
    principal_point2: Any,
    config: RansacConfig | None = None,
) -> Estimate[FocalMotion]:
    """Relative pose and focal length of each camera: seven points, F and Bougnoux' formula, then Sampson error.

    If the optical axes intersect, or are coplanar with the baseline, the focal lengths are undetermined; close to that they are
    very uncertain. A shared focal length is far better determined.

    Args:
        pixels1: matches in image 1, (n, 2); rows with NaN or infinity are outliers.
        pixels2: the same in image 2.
        principal_point1: (2,).
        principal_point2: (2,).
        config: threshold in pixels.

    Returns:
        `covariance` (7, 7) of the rotation from the left (3), the step of t in its tangent plane (2) and the log focal
        lengths.

    Raises:
        ShapeError: array sizes do not match.
    """
    return _fit(
        TwoFocalsProblem,
        pixels1,
        pixels2,
        principal_point1,
        principal_point2,
        options_of(RansacConfig, config),
    )


def _fit(
    kind: Any, pixels1: Any, pixels2: Any, center1: Any, center2: Any, config: RansacConfig
) -> Estimate[FocalMotion]:
    p1 = as_points(pixels1, "pixels1", 2) - as_float_array(center1, "principal_point", 2, finite=True)
    p2 = as_points(pixels2, "pixels2", 2) - as_float_array(center2, "principal_point", 2, finite=True)
    n = require_same_length(pixels1=p1, pixels2=p2)
    matches = np.concatenate([p1, p2], axis=1)
    order = random_order(usable_rows(matches), config)
    usable = matches[order]
    spread = float(np.sqrt((usable**2).mean() * 2.0)) if len(usable) else 1.0
    spread = spread if spread > 0 else 1.0
    problem = kind(np.ascontiguousarray((usable / spread).T))
    found = run_loop(problem, order, n, spread, config, None)
    motion = Rigid3(found.raw[9:18].reshape(3, 3).copy(), found.raw[18:21].copy())
    model = FocalMotion(motion, float(spread * found.raw[FOCAL1]), float(spread * found.raw[FOCAL2]))
    return found.estimate(model)
