"""Matches in the form used by motion estimators: points on the plane z = 1, or rays with derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_points
from epipole.cameras import Camera

_UNEVEN = 1.25
"""Ratio of pixel sizes on the plane z = 1, relative to the center, above which a camera is wide-angle."""


def rays_on_plane(camera: Camera, pixels: Any, name: str = "pixels") -> Float64[np.ndarray, "n 2"]:
    """Intersections of the rays of pixels (n, 2) with the plane z = 1; NaN if there is none."""
    rays = camera.unproject(as_points(pixels, name, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rays[:, 2:] > 1e-3, rays[:, :2] / rays[:, 2:], np.nan)


def is_wide(camera: Camera) -> bool:
    """Whether pixel sizes differ strongly on the plane z = 1, or some rays never intersect it."""
    if not camera.model.distortion_indices:
        return False
    grid = np.meshgrid(np.linspace(0.0, camera.width - 1.0, 9), np.linspace(0.0, camera.height - 1.0, 9))
    pixels = np.stack(grid, axis=-1).reshape(-1, 2)
    rays, on_plane = camera.unproject(pixels), rays_on_plane(camera, pixels)
    meets = np.isfinite(on_plane).all(axis=1)
    if np.isfinite(rays[~meets]).all(axis=1).any():
        return True
    on_plane = np.concatenate([on_plane[meets], np.ones((int(meets.sum()), 1))], axis=1)
    _, jacobian, _ = camera.project_with_jacobian(on_plane)
    sizes = np.linalg.svd(jacobian[:, :, :2] / camera.focal_px, compute_uv=False)
    return bool((sizes > _UNEVEN).any() or (sizes < 1.0 / _UNEVEN).any())
