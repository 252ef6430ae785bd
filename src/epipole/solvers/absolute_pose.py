"""Pose of a calibrated camera from minimal points, for callers with arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from epipole._checks import as_float_array
from epipole.geometry import Rigid3
from epipole.solvers import _absolute_pose_kernels as kernels


def solve_p3p(rays_in_cam: Any, points_in_world: Any) -> Rigid3:
    """All cam_from_world of three points, s_i y_i = R X_i + t with s_i > 0 (Grunert 1841; Haralick et al. 1994).

    Args:
        rays_in_cam: directions, (3, 3), any length.
        points_in_world: (3, 3), not collinear.

    Returns:
        Rigid3 of batch shape (k,), k between 0 and 4.
    """
    rays = as_float_array(rays_in_cam, "rays_in_cam", 3, 3, finite=True)
    points = as_float_array(points_in_world, "points_in_world", 3, 3, finite=True)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    out = np.empty((4, 12))
    found = out[: kernels.p3p(rays, points, out, kernels.p3p_workspace())]
    return Rigid3(found[:, :9].reshape(-1, 3, 3).copy(), found[:, 9:].copy())
