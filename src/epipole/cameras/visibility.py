"""Visibility of rays: a camera sees a ray if it projects into the image and unprojects back to the same ray."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import as_points, checked
from epipole.cameras.camera import Camera

MAX_DEVIATION = 1e-3
"""Largest distance between a unit ray and the unprojection of its pixel."""


@checked
def project_visible(
    camera: Camera, rays_in_cam: Any
) -> tuple[Float64[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Pixels of rays (n, 3) of any length, and whether the camera sees each of them.

    Beyond its fold, polynomial distortion maps rays back into the image: such pixels unproject to other rays. Pixels that are not
    visible have the value of the formula, or NaN.
    """
    rays = as_points(rays_in_cam, "rays_in_cam", 3)
    pixels = camera.project(rays)
    visible_mask = (
        np.isfinite(pixels).all(axis=1)
        & (pixels > -0.5).all(axis=1)
        & (pixels < [camera.width - 0.5, camera.height - 0.5]).all(axis=1)
    )
    if len(camera.model.distortion_indices):
        seen = rays[visible_mask]
        back = camera.unproject(pixels[visible_mask])
        unit = seen / np.linalg.norm(seen, axis=1, keepdims=True)
        visible_mask[visible_mask] = np.linalg.norm(back - unit, axis=1) < MAX_DEVIATION
    return pixels, visible_mask
