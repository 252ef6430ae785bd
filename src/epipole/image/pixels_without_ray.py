"""Pixels for which a camera model has no ray, where features are ignored."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from epipole.cameras import Camera, CameraModel

_STEP_PX = 4  # spacing of the pixels that are unprojected; the region is widened by one step
_MOST_STEPS = 200  # along a side


def pixels_without_ray(camera: Camera) -> np.ndarray | None:
    """(h, w) mask of pixels at or near which the distortion has no inverse; None if all pixels have a ray."""
    if not camera.model.distortion_indices:
        return None
    return _blind(camera.model, camera.width, camera.height, tuple(camera.params.tolist()))


def no_ray_warning(camera: Camera) -> list[str]:
    """A warning with the fraction of the image that has no ray; empty if all pixels have one."""
    blind = pixels_without_ray(camera)
    if blind is None:
        return []
    return [
        f"{blind.mean():.1%} of the image ({int(blind.sum())} pixels) has no ray in the {camera.model.name} camera model, and "
        "features there are dropped: check the distortion coefficients"
    ]


@lru_cache(maxsize=4)
def _blind(model: CameraModel, width: int, height: int, params: tuple[float, ...]) -> np.ndarray | None:
    camera, step = (
        Camera(model, width, height, np.array(params)),
        max(_STEP_PX, max(width, height) // _MOST_STEPS),
    )
    columns, rows = (np.unique([*range(0, side, step), side - 1]) for side in (width, height))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
    # Distortion increases outwards, so any region without rays reaches the border.
    is_border = (pixels == 0).any(axis=1) | (pixels == (width - 1, height - 1)).any(axis=1)
    if np.isfinite(camera.unproject(pixels[is_border])).all():
        return None
    has_none = ~np.isfinite(camera.unproject(pixels)).all(axis=1)
    mask = np.zeros((height, width), np.uint8)
    mask[pixels[has_none, 1].astype(int), pixels[has_none, 0].astype(int)] = 1
    side = 2 * step + 1
    out = cv2.dilate(mask, np.ones((side, side), np.uint8)) > 0
    out.flags.writeable = False
    return out
