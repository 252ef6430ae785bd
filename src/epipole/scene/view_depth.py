"""Depth of each pixel of a view, with its standard deviation and the reason where it is unknown."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float32, UInt8

from epipole._checks import Declared
from epipole.scene.notebook import table_html


class DepthReason(IntEnum):
    """Why a pixel of a view has no depth, or OK."""

    OK = 0
    OUT_OF_VIEW = 1
    """No other view shows it."""
    OCCLUDED = 2
    """It is hidden in the other views, or wrongly matched."""
    TEXTURELESS = 3
    """There is no texture along the epipolar lines: a blank wall, or sky."""
    AMBIGUOUS = 4
    """Other depths fit as well, or its region is small."""
    DISAGREEING = 5
    """Too few other views have the same depth."""
    UNCERTAIN = 6
    """Its standard deviation is too large."""
    MASKED = 7
    """The mask excludes it."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewDepth(Declared):
    """Depth along the optical axis of each pixel of an undistorted view."""

    depth: Float32[np.ndarray, "h w"]
    """In units of the model; NaN where unknown."""
    sigma: Float32[np.ndarray, "h w"]
    """Standard deviation of the depth; NaN where unknown."""
    reason: UInt8[np.ndarray, "h w"]
    """Values of `DepthReason`."""
    num_agreeing: UInt8[np.ndarray, "h w"]
    """Number of other views with the same depth."""

    @property
    def density(self) -> float:
        """Fraction of pixels with a depth."""
        return float((self.reason == DepthReason.OK).mean())

    def __repr__(self) -> str:
        height, width = self.reason.shape
        return f"ViewDepth({width} x {height}, {100 * self.density:.1f} % known)"

    def _repr_html_(self) -> str:
        return table_html("ViewDepth", {"known": f"{100 * self.density:.1f} %"}, self.depth)
