"""Points of a depth map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import Declared, as_float_array, as_table
from epipole.errors import ShapeError


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud(Declared):
    """Points of a depth map."""

    points_in_cam: Float64[np.ndarray, "n 3"]
    mask: Bool[np.ndarray, "h w"]
    """The pixels of the points, in row-major order."""

    def __len__(self) -> int:
        return len(self.points_in_cam)

    def __repr__(self) -> str:
        height, width = self.mask.shape
        return f"PointCloud({len(self)} points of {width} x {height} pixels)"


def depth_map_to_point_cloud(depth: Any, K: Any) -> PointCloud:
    """The points (Z (x - cx) / fx, Z (y - cy) / fy, Z) of a depth map.

    Args:
        depth: (h, w); NaN, infinite or non-positive pixels give no point.
        K: (3, 3) intrinsics without skew.

    Raises:
        ShapeError: an array has the wrong shape.
    """
    z = as_float_array(depth, "depth")
    matrix = as_table(K, "K", 3, 3)
    if z.ndim != 2:
        raise ShapeError(f"depth must be (h, w), got {z.shape}")
    with np.errstate(invalid="ignore"):
        mask = np.isfinite(z) & (z > 0)
    y, x = np.nonzero(mask)
    seen = z[mask]
    points = np.stack(
        [seen * (x - matrix[0, 2]) / matrix[0, 0], seen * (y - matrix[1, 2]) / matrix[1, 1], seen], axis=1
    )
    return PointCloud(points, mask)
