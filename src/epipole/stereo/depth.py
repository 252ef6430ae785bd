"""From disparities to metres: depth, its standard deviation, points and their covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from epipole.cameras import CameraModel
from epipole.config import RigOptions
from epipole.errors import ConfigError
from epipole.geometry import depth_error, disparity_to_depth
from epipole.scene import StereoRig
from epipole.stereo.matching import DisparityMap

_NEAREST, _FARTHEST = 8.0, 800.0  # baselines
_SAME = 1e-6  # relative: a thousandth of a pixel across a picture


@dataclass(frozen=True, slots=True)
class RectifiedRig:
    """Two cameras side by side with parallel axes and rows in common."""

    focal_px: float
    cx: float
    """Principal point of the left camera."""
    cy: float
    baseline: float
    """In any unit; depth comes in the same."""
    principal_offset_px: float = 0.0
    """cx_right - cx_left (Middlebury's `doffs`)."""
    focal_sigma_px: float = 0.0
    """Standard deviations of what a calibration has found; zero where nothing is known of them."""
    baseline_sigma: float = 0.0
    principal_offset_sigma_px: float = 0.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: focal length or baseline is not positive, or a number is missing.
        """
        for name, value in (("focal_px", self.focal_px), ("baseline", self.baseline)):
            if not 0 < value < np.inf:
                hint = "; are left and right swapped?" if name == "baseline" and value < 0 else ""
                raise ConfigError(f"{name} must be positive and finite, got {value}{hint}")
        if not np.isfinite([self.cx, self.cy, self.principal_offset_px]).all():
            raise ConfigError("cx, cy and principal_offset_px must be finite numbers")
        sigmas = (self.focal_sigma_px, self.baseline_sigma, self.principal_offset_sigma_px)
        if not all(0 <= value < np.inf for value in sigmas):
            raise ConfigError(f"standard deviations of a rig must not be negative, got {sigmas}")

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:
        """Of the left camera."""
        return np.array([[self.focal_px, 0.0, self.cx], [0.0, self.focal_px, self.cy], [0.0, 0.0, 1.0]])

    def calibration_sigma(self, disparity_px: Float[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
        """Error of each disparity, in pixels, that stands for those of f, B and the principal points: Z = f B / (d + o)."""
        relative = (self.focal_sigma_px / self.focal_px) ** 2 + (self.baseline_sigma / self.baseline) ** 2
        shifted = disparity_px.astype(np.float64) + self.principal_offset_px
        return np.sqrt(relative * shifted**2 + self.principal_offset_sigma_px**2)

    def round_ranges(self) -> list[float]:
        """Depths 1, 2, 5, 10 ... from 8 to 800 baselines: the ranges of use."""
        exponent = int(np.floor(np.log10(_NEAREST * self.baseline)))
        steps = [m * 10.0**k for k in range(exponent, exponent + 4) for m in (1, 2, 5)]
        return [z for z in steps if _NEAREST * self.baseline <= z <= _FARTHEST * self.baseline]


def rig_from_options(options: RigOptions, size: tuple[int, int]) -> RectifiedRig | None:
    """The rig of a rectified pair whose pictures have a width and height; None where nothing of it is known.

    Raises:
        ConfigError: one of focal length and baseline is missing, or not positive.
    """
    if options.focal_px is None and options.baseline is None:
        return None
    if options.focal_px is None or options.baseline is None:
        missing = "focal_px" if options.focal_px is None else "baseline"
        raise ConfigError(f"depth needs both focal_px and baseline; {missing} is missing")
    cx, cy = options.principal_point or ((size[0] - 1) / 2, (size[1] - 1) / 2)
    return RectifiedRig(
        options.focal_px,
        *(cx, cy, options.baseline, options.principal_offset_px),
        *(options.focal_sigma_px, options.baseline_sigma, options.principal_offset_sigma_px),
    )


def rectified_rig_of(rig: StereoRig) -> RectifiedRig | None:
    """The same as a rectified pair, where the cameras already stand so (KITTI, Middlebury): nothing needs resampling.

    None for any other rig, and for one with a covariance, which needs the cameras' own parameters.
    """
    left, right, motion = rig.left, rig.right, rig.right_from_left
    if rig.covariance is not None or (left.width, left.height) != (right.width, right.height):
        return None
    K1, K2 = left.K, right.K
    focal, baseline = float(K1[0, 0]), rig.baseline
    is_flat = (
        not any(camera.params[list(camera.model.distortion_indices)].any() for camera in (left, right))
        and np.allclose([K1[1, 1], K2[0, 0], K2[1, 1]], focal, rtol=_SAME, atol=0)
        and abs(K2[1, 2] - K1[1, 2]) < _SAME * focal
        and np.abs(motion.rotation - np.eye(3)).max() < _SAME
        and np.abs(motion.translation - [-baseline, 0, 0]).max() < _SAME * baseline
    )
    if not is_flat or CameraModel.OPENCV_FISHEYE in (left.model, right.model):
        return None
    return RectifiedRig(
        focal, float(K1[0, 2]), float(K1[1, 2]), baseline, principal_offset_px=float(K2[0, 2] - K1[0, 2])
    )


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """Depth of the left picture's pixels, in the unit of the baseline."""

    depth: Float64[np.ndarray, "h w"]
    """z in the left camera; NaN where unknown."""
    sigma: Float64[np.ndarray, "h w"]
    """Standard deviation of the depth, from disparity and calibration together; NaN where unknown."""
    calibration_sigma: Float64[np.ndarray, "h w"]
    """The calibration's part of it, which neighbours share: averaging does not lessen it. Zero where nothing is known
    of the calibration's errors."""

    def __repr__(self) -> str:
        height, width = self.depth.shape
        known = np.isfinite(self.depth)
        if not known.any():
            return f"DepthMap({width} x {height}, nothing known)"
        near, far = np.percentile(self.depth[known], [1, 99])
        return f"DepthMap({width} x {height}, {100 * known.mean():.1f} % known, {near:.3g} to {far:.3g})"


def depth_of(
    disparities: DisparityMap,
    rig: RectifiedRig,
    calibration_sigma_px: Float64[np.ndarray, "h w"] | None = None,
) -> DepthMap:
    """Z = f B / (d + o) and its first-order standard deviation Z^2 / (f B) sigma.

    Points at infinity have neither.

    Args:
        disparities: of the left picture.
        rig: focal length, baseline and principal points.
        calibration_sigma_px: what the calibration's errors come to in pixels of disparity
            (`stereo.calibration_error`); None: from the rig's own standard deviations.
    """
    depth = disparity_to_depth(disparities.disparity_px, rig.focal_px, rig.baseline, rig.principal_offset_px)
    depth = np.where(np.isfinite(depth), depth, np.nan)
    if calibration_sigma_px is None:
        calibration_sigma_px = rig.calibration_sigma(disparities.disparity_px)
    together = np.hypot(disparities.sigma_px, calibration_sigma_px)
    return DepthMap(
        depth,
        depth_error(depth, rig.focal_px, rig.baseline, together),
        depth_error(depth, rig.focal_px, rig.baseline, calibration_sigma_px),
    )


def point_covariances(
    depths: DepthMap, rig: RectifiedRig, pixel_sigma_px: float = 0.3
) -> Float64[np.ndarray, "h w 3 3"]:
    """First-order covariance of every pixel's point: a needle along its ray.

    X = Z r with r = ((x - cx) / f, (y - cy) / f, 1): r r^T sigma_Z^2, and Z^2 / f^2 times the variance of where in its pixel
    the point lies (0.3 px: anywhere in it).

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
