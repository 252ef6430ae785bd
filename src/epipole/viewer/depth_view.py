"""The depth of a pair as the viewer shows it: its points, the pictures, and how sure each point is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

from epipole.errors import ShapeError


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """What is shown."""

    points_in_cam: Float64[np.ndarray, "n 3"]
    point_rgb: UInt8[np.ndarray, "n 3"]
    relative_sigma: Float64[np.ndarray, " n"]
    """Standard deviation of each point's depth over its depth."""
    left_rgb: UInt8[np.ndarray, "h w 3"]
    depth_rgb: UInt8[np.ndarray, "h w 3"]
    """Depth in colours."""
    focal_px: float

    def __post_init__(self) -> None:
        """Check that there is something to see.

        Raises:
            ShapeError: there is no point, or the columns differ in length.
        """
        if not len(self.points_in_cam):
            raise ShapeError("there is no point to show")
        if not len(self.points_in_cam) == len(self.point_rgb) == len(self.relative_sigma):
            raise ShapeError("points, colours and errors differ in number")
