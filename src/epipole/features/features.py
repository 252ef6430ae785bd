"""Keypoints and descriptors of one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from epipole._checks import Declared


@dataclass(frozen=True, slots=True, eq=False)
class Features(Declared):
    """One row per feature, strongest scale first."""

    pixels: Float32[np.ndarray, "n 2"]
    """In pixels of the full image; (0, 0) is the center of the top-left pixel."""
    scale_px: Float32[np.ndarray, " n"]
    """Diameter of the described region."""
    angle_rad: Float32[np.ndarray, " n"]
    descriptors: UInt8[np.ndarray, "n d"]
    """Root-SIFT times 512 (d = 128), or ORB bits (d = 32)."""

    def __len__(self) -> int:
        return len(self.pixels)

    def largest(self, count: int) -> Features:
        """The largest features, at most `count`."""
        return Features(
            self.pixels[:count], self.scale_px[:count], self.angle_rad[:count], self.descriptors[:count]
        )

    def __repr__(self) -> str:
        return f"Features({len(self)} x {self.descriptors.shape[1]})"


def in_order(
    columns: Float32[np.ndarray, "n 4"], descriptors: UInt8[np.ndarray, "n d"], limit: int
) -> Features:
    """Features from columns x, y, diameter and angle, sorted by decreasing size, then position; at most `limit`."""
    order = np.lexsort((columns[:, 3], columns[:, 0], columns[:, 1], -columns[:, 2]))[:limit]
    columns = columns[order]
    return Features(
        np.ascontiguousarray(columns[:, :2]),
        columns[:, 2].copy(),
        columns[:, 3].copy(),
        np.ascontiguousarray(descriptors[order]),
    )
