"""Disparity and depth maps of one image, with standard deviations."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from epipole._checks import Declared
from epipole.scene.notebook import table_html


class StereoReason(IntEnum):
    """Why a pixel has no disparity, or OK."""

    OK = 0
    OCCLUDED = 1
    """The other image's disparity differs: occluded there, or wrongly matched."""
    OUT_OF_VIEW = 2
    """Its match would lie outside the other image."""
    AMBIGUOUS = 3
    """Another disparity fits nearly as well: repeated texture."""
    SPECKLE = 4
    """It belongs to a small isolated region."""
    TEXTURELESS = 5
    """There is no texture along the row, so only smoothness would determine the disparity."""
    UNCERTAIN = 6
    """Its standard deviation is larger than `max_sigma_px`."""


@dataclass(frozen=True, slots=True, eq=False)
class DisparityMap(Declared):
    """Disparities of the left image: x_right = x_left - disparity."""

    disparity_px: Float32[np.ndarray, "h w"]
    """NaN where unknown."""
    sigma_px: Float32[np.ndarray, "h w"]
    """Standard deviation of the disparity; NaN where unknown."""
    reason: UInt8[np.ndarray, "h w"]
    """Values of `StereoReason`."""

    @property
    def density(self) -> float:
        """Fraction of pixels with a disparity."""
        return float((self.reason == StereoReason.OK).mean())

    def __repr__(self) -> str:
        height, width = self.reason.shape
        return f"DisparityMap({width} x {height}, {100 * self.density:.1f} % known)"

    def _repr_html_(self) -> str:
        return table_html("DisparityMap", {"known": f"{100 * self.density:.1f} %"}, self.disparity_px)


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap(Declared):
    """Depth of the left image's pixels, in the unit of the baseline."""

    depth: Float64[np.ndarray, "h w"]
    """z in the left camera; NaN where unknown."""
    sigma: Float64[np.ndarray, "h w"]
    """Standard deviation of the depth, from disparity and calibration; NaN where unknown."""
    calibration_sigma: Float64[np.ndarray, "h w"]
    """The part of it due to calibration, which neighbors share, so averaging does not reduce it. Zero if the calibration has no
    stated uncertainty."""

    def __repr__(self) -> str:
        height, width = self.depth.shape
        known = np.isfinite(self.depth)
        if not known.any():
            return f"DepthMap({width} x {height}, no depth)"
        near, far = np.percentile(self.depth[known], [1, 99])
        return f"DepthMap({width} x {height}, {100 * known.mean():.1f} % known, {near:.3g} to {far:.3g})"

    def _repr_html_(self) -> str:
        return table_html("DepthMap", {"known": f"{100 * np.isfinite(self.depth).mean():.1f} %"}, self.depth)
