"""What matches are to the estimators of motion: points on the plane z = 1, or rays with their slopes."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_points
from epipole.cameras import Camera

_UNEVEN = 1.25
"""Sizes of a pixel on the plane z = 1, over that in the middle, from which on the plane is no picture."""


def rays_on_plane(camera: Camera, pixels: Any, name: str = "pixels") -> Float64[np.ndarray, "n 2"]:
    """Where the rays of pixels (n, 2) cross the plane z = 1 before the camera; NaN where they do not."""
    rays = camera.unproject(as_points(pixels, name, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rays[:, 2:] > 1e-3, rays[:, :2] / rays[:, 2:], np.nan)


def is_wide(camera: Camera) -> bool:
    """Whether pixels at the rim of the picture are of another size on the plane z = 1, or never meet it."""
    if not camera.model.distortion_indices:
        return False
    u, v = np.linspace(0.0, camera.width - 1.0, 5), np.linspace(0.0, camera.height - 1.0, 5)
    rim = [(a, b) for a in u for b in v if a in (u[0], u[-1]) or b in (v[0], v[-1])]
    seen = rays_on_plane(camera, rim)
    if not np.isfinite(seen).all():
        return bool(np.isfinite(camera.unproject(rim)[~np.isfinite(seen).all(axis=1)]).any())
    _, jacobian, _ = camera.project_with_jacobian(np.concatenate([seen, np.ones((len(seen), 1))], axis=1))
    sizes = np.linalg.svd(jacobian[:, :, :2] / camera.focal_px, compute_uv=False)
    return bool((sizes > _UNEVEN).any() or (sizes < 1.0 / _UNEVEN).any())


def rays_with_slopes(
    camera1: Camera, pixels1: Any, camera2: Camera, pixels2: Any, scale_px: float
) -> Float64[np.ndarray, "n 18"]:
    """Rows of `WideMotionProblem`: both unit rays, and their derivatives by pixels, times `scale_px`."""
    y1, slope1 = camera1.unproject_with_jacobian(pixels1)
    y2, slope2 = camera2.unproject_with_jacobian(pixels2)
    slopes = (scale_px * slope.reshape(-1, 6) for slope in (slope1, slope2))
    return np.concatenate([y1, y2, *slopes], axis=1)
