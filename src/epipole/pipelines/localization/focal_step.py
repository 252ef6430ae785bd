"""Whether known points contradict the focal length with which a pose was computed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.mapping import camera_with_focal

STEP = 1e-6
"""Relative step of the numerical derivatives."""
CAUCHY_SCALE = 2.0
"""Scale of the loss, in standard deviations."""


class FocalStep(NamedTuple):
    """One Gauss-Newton step of pose and focal length together, from a pose that is optimal for its focal length."""

    log_focal: float
    """Change of the logarithm of the focal length."""
    sigma: float
    """Standard deviation of the logarithm; infinite if the points do not determine the focal length."""
    covariance: Float64[np.ndarray, "6 6"]
    """Of the pose, where the focal length is unknown, too."""


def focal_step(
    points_in_world: np.ndarray, pixels: np.ndarray, camera: Camera, cam_from_world: Rigid3, sigma_px: float
) -> FocalStep:
    """Step of the focal length that reduces the reprojection errors most.

    This is the score test of a fixed parameter (C. R. Rao, 1948) with a covariance from the residuals (H. White, Econometrica 1980).
    Residuals are weighted with Cauchy's loss, w = 1 / (1 + |r|^2 / (c sigma)^2).

    Args:
        points_in_world: (n, 3).
        pixels: (n, 2), their observations.
        camera: intrinsics.
        cam_from_world: the pose.
        sigma_px: standard deviation of a pixel.
    """
    in_cam = cam_from_world.apply(points_in_world)
    projected = camera.project(in_cam)
    residual = pixels - projected
    used = np.isfinite(residual).all(axis=1)
    in_cam, projected, residual = in_cam[used], projected[used], residual[used]
    size = float(np.median(np.abs(in_cam))) if len(in_cam) else 1.0
    columns = []
    for axis in np.eye(3):
        columns.append((camera.project(in_cam + STEP * size * axis) - projected) / (STEP * size))
    for axis in np.eye(3):
        columns.append((camera.project(in_cam + STEP * np.cross(axis, in_cam)) - projected) / STEP)
    columns.append((camera_with_focal(camera, 1.0 + STEP).project(in_cam) - projected) / STEP)
    jacobian = np.stack(columns, axis=-1) / sigma_px
    residual = residual / sigma_px
    weight = 1.0 / (1.0 + (residual**2).sum(axis=1) / CAUCHY_SCALE**2)
    information = np.einsum("n,nia,nib->ab", weight, jacobian, jacobian)
    scores = np.einsum("n,nia,ni->na", weight, jacobian, residual)
    unknown = FocalStep(0.0, np.inf, np.full((6, 6), np.inf))
    count = len(residual)
    if count <= 7 or not np.isfinite(information).all():
        return unknown
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("ii->i", information), 1e-300))
    scaled = information * np.outer(scale, scale)
    if np.linalg.eigvalsh(scaled)[0] < 1e-12:
        return unknown
    inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
    step = inverse @ scores.sum(axis=0)
    covariance = inverse @ (scores.T @ scores) @ inverse * (count / (count - 3.5)) ** 2
    return FocalStep(float(step[6]), float(np.sqrt(covariance[6, 6])), covariance[:6, :6])
