"""Robust estimators of where a camera, or a rig of cameras, stands before known points."""

from __future__ import annotations

from typing import Any

import numpy as np

from epipole._checks import as_points, require_same_length
from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.geometry import Rigid3
from epipole.robust._absolute_pose_kernels import ROWS, AbsolutePoseProblem, pack_rays
from epipole.robust.estimate import Estimate, checked_quality, random_order, run_loop

_HERE = np.concatenate([np.eye(3).ravel(), np.zeros(3)])


def estimate_absolute_pose(
    points_in_world: Any,
    pixels: Any,
    camera: Camera,
    config: RansacConfig | None = None,
    *,
    quality: Any = None,
) -> Estimate[Rigid3]:
    """Pose of a calibrated camera: P3P (Ding et al., CVPR 2023), then the truncated reprojection error.

    Errors are those of the true camera model, fisheye too, to first order in the error. Points behind the camera
    are outliers.

    Args:
        points_in_world: (n, 3); NaN and infinite ones are outliers.
        pixels: where the camera saw them, (n, 2).
        camera: any model.
        config: threshold in pixels.
        quality: (n,), higher is better; good matches are then tried first (PROSAC).

    Returns:
        `model` = cam_from_world; `covariance` (6, 6) of xi in exp(xi) @ cam_from_world, xi = (translation, rotation).

    Raises:
        ShapeError: the arrays do not fit.
    """
    config = config or RansacConfig()
    points, pixels = as_points(points_in_world, "points_in_world", 3), as_points(pixels, "pixels", 2)
    n = require_same_length(points_in_world=points, pixels=pixels)
    usable = np.isfinite(points).all(axis=1) & np.isfinite(pixels).all(axis=1)
    order = random_order(usable, config)
    items = np.empty((ROWS, len(order)))
    pack_rays(int(camera.model), camera.padded_params(), _HERE, points, pixels, order, items)
    seen = np.isfinite(items).all(axis=0)
    if not seen.all():
        order, items = order[seen], np.ascontiguousarray(items[:, seen])
    found = run_loop(AbsolutePoseProblem(items), order, n, 1.0, config, checked_quality(quality, n))
    motion = Rigid3(found.raw[:9].reshape(3, 3).copy(), found.raw[9:12].copy())
    return found.estimate(motion)
