"""Disparities, depth and points of a pair of images in memory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from epipole.disparity_search.rectification import Rectification, rectify, within_both
from epipole.disparity_search.search import match_stereo
from epipole.errors import ConfigError, ShapeError
from epipole.pipelines.stereo.calibration_error import calibration_sigma
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.depth import depth_of
from epipole.pipelines.stereo.filling import FilledDisparities, fill_disparities
from epipole.pipelines.stereo.rigs import rectified_rig_of
from epipole.pipelines.stereo.rows import MatchedPair, quick_warnings
from epipole.pipelines.stereo.uncalibrated import UncalibratedRectification, rectify_uncalibrated
from epipole.scene import DepthMap, DisparityMap, RectifiedRig, StereoRig
from epipole.scene.notebook import table_html

_FITTED_WITH = (
    "window",
    "brightness_cost",
    "small_penalty",
    "edge_penalty",
    "edge_fade",
    "median_px",
    "block_px",
)


@dataclass(frozen=True, slots=True, eq=False)
class StereoResult:
    """Result of `stereo` for one pair."""

    left_rgb: UInt8[np.ndarray, "h w 3"]
    """Rectified, as are all maps."""
    right_rgb: UInt8[np.ndarray, "h w 3"]
    disparities: DisparityMap
    rig: RectifiedRig | None
    """The rectified cameras; None: there is no depth."""
    depths: DepthMap | None
    rectification: Rectification | UncalibratedRectification | None
    """None for a pair that was already rectified."""
    warnings: tuple[str, ...]
    num_points: int
    filled: FilledDisparities | None = None
    """Disparities with interpolated unknown pixels, if `StereoConfig.fill` is set."""
    out: Path | None = None
    """Output folder."""
    unit: str = "the baseline's unit"
    """Unit of the depths, as text."""

    @property
    def error_model(self) -> str:
        """Which errors the standard deviations cover, and which they exclude."""
        if self.depths is None:
            calibration = ""
        elif self._knows_calibration:
            calibration = " The standard deviation of depth includes calibration errors."
        else:
            calibration = " The standard deviation of depth excludes calibration errors, which are unknown."
        return (
            "The standard deviation of a disparity covers matching errors, as calibrated on rendered rooms. It excludes a constant"
            " offset of all disparities, which many rectifications leave: with an offset of a third of a pixel, far fewer than 68 % of"
            f" the errors lie within one standard deviation (epipole stereo doctor detects the offset).{calibration}"
        )

    @property
    def _knows_calibration(self) -> bool:
        """Whether the standard deviation of depth includes calibration errors."""
        if self.depths is None or self.rig is None:
            return False
        known = np.isfinite(self.depths.depth)
        d, sigma_px = self.disparities.disparity_px[known], self.disparities.sigma_px[known]
        depth, sigma = self.depths.depth[known].astype(np.float64), self.depths.sigma[known]
        own = depth**2 / (self.rig.focal_px * self.rig.baseline) * sigma_px
        return bool(len(d) and np.median(sigma / np.maximum(own, 1e-12)) > 1.0 + 1e-3)

    def __repr__(self) -> str:
        depth = "no depth" if self.depths is None else f"{self.num_points} points"
        return f"StereoResult({self.disparities!r}, {depth}, in {self.out})"

    def _repr_html_(self) -> str:
        image = self.disparities.disparity_px if self.depths is None else self.depths.depth
        rows = {
            "known": f"{100 * self.disparities.density:.1f} %",
            "depths in": self.unit,
            "folder": self.out,
        }
        return table_html("StereoResult", rows, image)


def measure_pair(
    left_rgb: UInt8[np.ndarray, "h1 w1 3"],
    right_rgb: UInt8[np.ndarray, "h2 w2 3"],
    config: StereoConfig,
    rig: RectifiedRig | StereoRig | None = None,
) -> StereoResult:
    """Rectify if the rig is a calibration, match, and compute depth if the rig is known.

    Raises:
        ShapeError: the sizes of the images do not match each other or the calibration.
        ConfigError: left and right are swapped in the calibration, the disparity range is invalid, or `uncalibrated` is
            combined with a rig.
        DegenerateGeometryError: the pair cannot be rectified.
    """
    left, right, flat, rectification = _rectified(left_rgb, right_rgb, config, rig)
    config = _down_to_infinity(config, flat)
    disparities = match_stereo(left, right, config)
    if rectification is not None:
        disparities = within_both(disparities, rectification.left_valid, rectification.right_valid)
    warnings = list(quick_warnings(left, right, _matched(disparities, config, isinstance(rig, StereoRig))))
    warnings += _limits(config, rig)
    depths, num_points = None, 0
    if flat is not None:
        wrong_px = None
        if (
            isinstance(rig, StereoRig)
            and rig.covariance is not None
            and isinstance(rectification, Rectification)
        ):
            wrong_px = calibration_sigma(rig, rectification, disparities.disparity_px)
        depths = depth_of(disparities, flat, wrong_px)
        num_points = int(np.isfinite(depths.depth).sum())
        if not num_points and disparities.density > 0:
            warnings.append(
                "no depth is positive and finite: every disparity plus the principal offset is at most zero"
            )
    filled = fill_disparities(disparities, left) if config.fill else None
    return StereoResult(
        left, right, disparities, flat, depths, rectification, tuple(warnings), num_points, filled
    )


class _RectifiedPair(NamedTuple):
    left: UInt8[np.ndarray, "h w 3"]
    right: UInt8[np.ndarray, "h w 3"]
    rig: RectifiedRig | None
    rectification: Rectification | UncalibratedRectification | None


def _rectified(
    left: np.ndarray, right: np.ndarray, config: StereoConfig, rig: RectifiedRig | StereoRig | None
) -> _RectifiedPair:
    if config.uncalibrated:
        if rig is not None:
            raise ConfigError("uncalibrated cannot be combined with a calibration: remove one of them")
        unknown = rectify_uncalibrated(left, right)
        return _RectifiedPair(*unknown.apply(left, right), None, unknown)
    if isinstance(rig, StereoRig):
        rig.check_image_sizes(left, right)
        flat = rectified_rig_of(rig)
        if flat is not None:
            return _RectifiedPair(left, right, flat, None)
        rectification = rectify(rig)
        return _RectifiedPair(*rectification.apply(left, right), rectification.rig, rectification)
    if left.shape != right.shape:
        (h1, w1), (h2, w2) = left.shape[:2], right.shape[:2]
        raise ShapeError(
            f"left is {w1} x {h1} pixels and right {w2} x {h2}: the images of a rectified pair must have the same size"
        )
    return _RectifiedPair(left, right, rig, None)


def _limits(config: StereoConfig, rig: RectifiedRig | StereoRig | None) -> list[str]:
    out = []
    default = StereoConfig()
    matters = [name for name in _FITTED_WITH if name != "block_px" or config.method == "block"]
    changed = [name for name in matters if getattr(config, name) != getattr(default, name)]
    if changed:
        words = f"standard deviations are calibrated for the default {', '.join(changed)}; with other values they are less accurate"
        out.append(words)
    if config.uncalibrated:
        out.append(
            "without a calibration, disparities determine depth only up to a projective transformation, which may reverse its order"
        )
    if isinstance(rig, StereoRig) and rig.covariance is None:
        out.append("the calibration has no covariance: sigma_depth includes disparity errors only")
    return out


def _down_to_infinity(config: StereoConfig, rig: RectifiedRig | None) -> StereoConfig:
    """The config with the disparity of infinity as minimum, which is negative for a positive principal offset."""
    if rig is None or config.min_disparity_px != 0 or rig.principal_offset_px <= 0:
        return config
    return replace(config, min_disparity_px=-int(np.ceil(rig.principal_offset_px)))


def _matched(disparities: DisparityMap, config: StereoConfig, is_calibrated: bool) -> MatchedPair:
    high = np.inf if config.max_disparity_px is None else float(config.max_disparity_px)
    return MatchedPair(disparities.density, (float(config.min_disparity_px), high), is_calibrated)
