"""Disparity and depth of a rectified pair, and their errors; scalars in, scalars out."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, check_broadcast, checked
from epipole.errors import ConfigError


@checked
def disparity_to_depth(
    disparity_px: Any, focal_px: float, baseline: float, principal_offset_px: float = 0.0
) -> Float64[np.ndarray, ...] | float:
    """Depth Z = f B / (d + o) of disparities d = x_left - x_right.

    Args:
        disparity_px: any shape; NaN stays NaN.
        focal_px: f of both rectified cameras.
        baseline: B, in the unit of the depth.
        principal_offset_px: o = cx_right - cx_left, if the principal points differ (Middlebury's `doffs`).

    Returns:
        Infinite where d + o is zero; NaN where it is negative, as no point in front of the cameras has it.

    Raises:
        ConfigError: focal length or baseline is not positive.
    """
    _check(focal_px, baseline)
    shifted = _numbers(disparity_px, "disparity_px") + principal_offset_px
    with np.errstate(divide="ignore"):
        return np.where(shifted >= 0, focal_px * baseline / np.abs(shifted), np.nan)[()]


@checked
def depth_to_disparity(
    depth: Any, focal_px: float, baseline: float, principal_offset_px: float = 0.0
) -> Float64[np.ndarray, ...] | float:
    """Disparity d = f B / Z - o; the inverse of `disparity_to_depth`. NaN where the depth is not positive.

    Raises:
        ConfigError: focal length or baseline is not positive.
    """
    _check(focal_px, baseline)
    z = _numbers(depth, "depth")
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(z > 0, focal_px * baseline / z - principal_offset_px, np.nan)[()]


@checked
def depth_error(
    depth: Any, focal_px: float, baseline: float, disparity_error_px: Any
) -> Float64[np.ndarray, ...] | float:
    """|dZ| = (Z^2 / (f B)) |dd|: it grows with the square of the depth, and decreases with focal length and baseline.

    Args:
        depth: Z, any shape, in the unit of the baseline.
        focal_px: f.
        baseline: B.
        disparity_error_px: standard deviation, or any small error, of the disparity.

    Raises:
        ConfigError: focal length or baseline is not positive.
    """
    _check(focal_px, baseline)
    z, error_px = _numbers(depth, "depth"), _numbers(disparity_error_px, "disparity_error_px")
    check_broadcast(depth=z.shape, disparity_error_px=error_px.shape)
    return (z * z / (focal_px * baseline) * np.abs(error_px))[()]


def _numbers(given: Any, name: str) -> np.ndarray:
    """The values as an array of the same shape, including 0-dimensional ones."""
    return as_float_array(given, name).reshape(np.shape(given))


def _check(focal_px: float, baseline: float) -> None:
    for name, value in (("focal_px", focal_px), ("baseline", baseline)):
        if not 0 < value < np.inf:
            raise ConfigError(f"{name} must be positive and finite, got {value}")
