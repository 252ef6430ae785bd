"""Pairs of images whose geometry contradicts the other pairs.

Images of different things that look alike (windows, facades, tiles) can have many matches that agree on a wrong motion.
Along a cycle of images, the relative rotations of right pairs multiply to the identity; a wrong one breaks its cycles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import Declared, checked
from epipole.mapping.rotation_averaging import average_rotations
from epipole.scene import ViewGraph


@dataclass(frozen=True, slots=True, eq=False)
class PairConsistency(Declared):
    """Agreement of each pair's rotation with those of all pairs."""

    contradicts: Bool[np.ndarray, " n"]
    angle_rad: Float64[np.ndarray, " n"]
    """Angle between the pair's rotation and the averaged one; NaN if the pair has no rotation."""
    cams_from_world: Float64[np.ndarray, "i 3 3"]
    """Averaged rotation of each image."""

    def __repr__(self) -> str:
        return f"PairConsistency({int(self.contradicts.sum())} of {len(self.contradicts)} pairs contradict)"


@checked
def check_rotation_cycles(
    view_graph: ViewGraph, num_images: int, has_rotation: Bool[np.ndarray, " n"], max_angle_rad: float
) -> PairConsistency:
    """Compare each pair with the rotations that most matches agree on (Zach et al., CVPR 2010, test cycles one by one).

    A pair that is in no cycle has no contradiction: nothing is known about it.

    Args:
        view_graph: verified pairs.
        num_images: number of images.
        has_rotation: pairs whose rotation can be trusted, because the intrinsics are known.
        max_angle_rad: largest angle between a pair's rotation and the averaged one.
    """
    rows = np.flatnonzero(has_rotation & np.isfinite(view_graph.cam2_from_cam1.rotation).all(axis=(1, 2)))
    angle = np.full(len(view_graph), np.nan)
    averaged = average_rotations(
        num_images,
        view_graph.image1[rows],
        view_graph.image2[rows],
        np.ascontiguousarray(view_graph.cam2_from_cam1.rotation[rows]),
        view_graph.num_inliers()[rows].astype(np.float64),
    )
    angle[rows] = averaged.residuals_rad
    return PairConsistency(np.nan_to_num(angle) > max_angle_rad, angle, averaged.cams_from_world)
