"""Points as columns, and their tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, Int64, UInt8

from epipole._checks import Declared


@dataclass(frozen=True, slots=True, eq=False)
class Points(Declared):
    """One row per 3D point."""

    xyz_in_world: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    error_px: Float64[np.ndarray, " n"]
    """Mean reprojection error over the point's track."""

    def __len__(self) -> int:
        return len(self.xyz_in_world)

    def __repr__(self) -> str:
        return f"Points({len(self)})"


@dataclass(frozen=True, slots=True, eq=False)
class Tracks(Declared):
    """Tracks in compressed rows: observations offsets[j] to offsets[j + 1] are those of point j."""

    offsets: Int64[np.ndarray, " n1"]
    image: Int32[np.ndarray, " k"]
    keypoint: Int32[np.ndarray, " k"]
    """Index among the image's own keypoints."""

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def point_of_observation(self) -> Int32[np.ndarray, " k"]:
        """The point of each observation."""
        return np.repeat(np.arange(len(self), dtype=np.int32), np.diff(self.offsets))

    def __repr__(self) -> str:
        return f"Tracks({len(self)}, {len(self.image)} observations)"
