"""Ground below what stands on it: a terrain model from a height model.

The simple morphological filter of Pingel, Clarke and McBride (ISPRS Journal 2013): the lowest heights of coarse cells are opened with larger and
larger windows; what rises above the opened surface by more than a slope times the window's radius is not ground. Between the ground cells, the
terrain is interpolated, and each fine cell near it is ground.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32

from epipole._checks import checked
from epipole.errors import ConfigError, ShapeError

COARSE_M = 0.5
"""Smallest side of a coarse cell in meters."""
SLOPE, WIDEST_M = 0.2, 20.0
"""Slope above which a rise is an object, and half the width of the widest objects in meters."""
THRESHOLD_M, SCALING_M = 0.3, 0.6
"""Ground differs from the terrain by at most this plus the scaling times the slope of the terrain."""


@checked
def terrain_model(height: Float32[np.ndarray, "h w"], resolution: float) -> Float32[np.ndarray, "h w"]:
    """Height of the ground of each known cell; NaN where the height is unknown.

    Objects that are wider than 40 m stay. So do slopes: a hill that rises by less than 20 % is ground.

    Args:
        height: height of each cell in meters; NaN where unknown.
        resolution: side of a cell in meters.

    Raises:
        ConfigError: resolution is not positive.
        ShapeError: no height is known.
    """
    if not 0.0 < resolution < np.inf:
        raise ConfigError(f"resolution must be positive, got {resolution}")
    known = np.isfinite(height)
    if not known.any():
        raise ShapeError("no height is known")
    low = np.float32(np.min(height[known]))
    above = np.where(known, height - low, np.float32(np.nan))
    step = max(1, round(COARSE_M / resolution))
    lowest, side = _lowest(above, step), resolution * step
    surface = filled(lowest)
    is_ground = np.isfinite(lowest) & ~_is_object(surface, side)
    if not is_ground.any():
        return height.copy()
    coarse = filled(np.where(is_ground, lowest, np.float32(np.nan)))
    slope_y, slope_x = (
        np.gradient(coarse, side, axis=axis) if coarse.shape[axis] > 1 else 0.0 * coarse for axis in (0, 1)
    )
    size = lowest.shape[1] * step, lowest.shape[0] * step
    rows, columns = height.shape
    terrain, slope = (
        np.asarray(cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))[
            :rows, :columns
        ]
        for image in (coarse, np.hypot(slope_x, slope_y))
    )
    with np.errstate(invalid="ignore"):
        near = np.abs(above - terrain) <= THRESHOLD_M + SCALING_M * slope
    smooth = filled(np.where(near, above, np.float32(np.nan))) if near.any() else terrain
    return np.where(known, smooth + low, np.float32(np.nan)).astype(np.float32)


def _lowest(height: np.ndarray, step: int) -> np.ndarray:
    """Lowest height of blocks of step x step cells; NaN where none is known."""
    rows, columns = (-(-side // step) for side in height.shape)
    padded = np.full((rows * step, columns * step), np.inf, np.float32)
    padded[: height.shape[0], : height.shape[1]] = np.where(np.isfinite(height), height, np.inf)
    lowest = padded.reshape(rows, step, columns, step).min(axis=(1, 3))
    return np.where(np.isfinite(lowest), lowest, np.float32(np.nan))


def _is_object(surface: np.ndarray, side: float) -> np.ndarray:
    """Cells that rise above the surface after an opening with one of the windows by more than the slope times its radius."""
    is_object, before = np.zeros(surface.shape, bool), surface
    for radius in range(1, max(1, int(np.ceil(WIDEST_M / side))) + 1):
        window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
        opened = cv2.morphologyEx(before, cv2.MORPH_OPEN, window, borderType=cv2.BORDER_REPLICATE)
        is_object |= before - opened > SLOPE * radius * side
        before = np.asarray(opened)
    return is_object


@checked
def filled(height: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Unknown heights (NaN) from the known ones around: means over larger and larger cells (push-pull; Gortler et al., SIGGRAPH 1996).

    Raises:
        ShapeError: no height is known.
    """
    known = np.isfinite(height)
    if known.all():
        return height
    if not known.any():
        raise ShapeError("no height is known")
    rows, columns = (-(-side // 2) for side in height.shape)
    padded = np.full((2 * rows, 2 * columns), np.nan, np.float32)
    padded[: height.shape[0], : height.shape[1]] = height
    cells = padded.reshape(rows, 2, columns, 2)
    count = np.isfinite(cells).sum(axis=(1, 3))
    mean = np.nansum(cells, axis=(1, 3)) / np.maximum(count, 1)
    coarse = filled(np.where(count > 0, mean, np.nan).astype(np.float32))
    fine = np.asarray(cv2.resize(coarse, (2 * columns, 2 * rows), interpolation=cv2.INTER_LINEAR))
    return np.where(known, height, fine[: height.shape[0], : height.shape[1]])
