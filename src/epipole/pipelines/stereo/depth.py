"""Depth from disparities, its standard deviation, and point covariances."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from epipole.errors import ConfigError
from epipole.geometry import depth_error, disparity_to_depth
from epipole.scene import DepthMap, DisparityMap, RectifiedRig

_SAME = 1e-6  # relative: a thousandth of a pixel across an image


def depth_of(
    disparities: DisparityMap,
    rig: RectifiedRig,
    calibration_sigma_px: Float64[np.ndarray, "h w"] | None = None,
) -> DepthMap:
    """Z = f B / (d + o) and its first-order standard deviation Z^2 / (f B) sigma; NaN for points at infinity.

    Args:
        disparities: of the left image.
        rig: focal length, baseline and principal points.
        calibration_sigma_px: calibration error in pixels of disparity (`calibration_sigma`); None: from the rig's own
            standard deviations.
    """
    depth = disparity_to_depth(disparities.disparity_px, rig.focal_px, rig.baseline, rig.principal_offset_px)
    depth = np.where(np.isfinite(depth), depth, np.nan)
    if calibration_sigma_px is None:
        calibration_sigma_px = rig.calibration_sigma(disparities.disparity_px)
    together = np.hypot(disparities.sigma_px, calibration_sigma_px)
    return DepthMap(
        depth,
        np.asarray(depth_error(depth, rig.focal_px, rig.baseline, together)),
        np.asarray(depth_error(depth, rig.focal_px, rig.baseline, calibration_sigma_px)),
    )


def point_covariances(
    depths: DepthMap, rig: RectifiedRig, pixel_sigma_px: float = 0.3
) -> Float64[np.ndarray, "h w 3 3"]:
    """First-order covariance of every pixel's point, elongated along its ray.

    X = Z r with r = ((x - cx) / f, (y - cy) / f, 1): the covariance is r r^T sigma_Z^2, plus Z^2 / f^2 times the variance of the
    position within the pixel (0.3 px: uniform).

    Raises:
        ConfigError: pixel_sigma_px is negative.
    """
    if not pixel_sigma_px >= 0:
        raise ConfigError(f"pixel_sigma_px must not be negative, got {pixel_sigma_px}")
    height, width = depths.depth.shape
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    ray = np.stack(
        [(x - rig.cx) / rig.focal_px, (y - rig.cy) / rig.focal_px, np.ones((height, width))], axis=-1
    )
    out = ray[..., :, None] * ray[..., None, :] * (depths.sigma**2)[..., None, None]
    aside = (depths.depth * pixel_sigma_px / rig.focal_px) ** 2
    out[..., 0, 0] += aside
    out[..., 1, 1] += aside
    return out
