"""Verified pairs of images, in compressed rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from epipole._checks import Declared, checked
from epipole.geometry import Rigid3


@dataclass(frozen=True, slots=True, eq=False)
class ViewGraph(Declared):
    """One row per verified pair; inlier matches of pair e are rows match_offsets[e] to match_offsets[e + 1]."""

    image1: Int32[np.ndarray, " n"]
    image2: Int32[np.ndarray, " n"]
    kind: Int32[np.ndarray, " n"]
    """`robust.PairKind` of each pair."""
    num_putative: Int32[np.ndarray, " n"]
    """Number of matches before verification."""
    match_offsets: Int64[np.ndarray, " n1"]
    keypoint1: Int32[np.ndarray, " m"]
    keypoint2: Int32[np.ndarray, " m"]
    cam2_from_cam1: Rigid3
    """|t| = 1; NaN if the pair determines no motion."""
    essential: Float64[np.ndarray, "n 3 3"]
    fundamental: Float64[np.ndarray, "n 3 3"]
    """In pixels; (0, 0) is the center of the top-left pixel."""
    homography: Float64[np.ndarray, "n 3 3"]
    median_angle_rad: Float64[np.ndarray, " n"]
    """Median triangulation angle of the inliers; NaN if there is none."""

    def __len__(self) -> int:
        return len(self.image1)

    def num_inliers(self) -> Int64[np.ndarray, " n"]:
        """Number of inlier matches of each pair."""
        return np.diff(self.match_offsets)

    @checked
    def select(self, keep: Bool[np.ndarray, " n"]) -> ViewGraph:
        """The pairs of a mask, with their matches."""
        return self._rows(np.flatnonzero(keep))

    def in_order(self) -> ViewGraph:
        """The pairs, sorted by their images."""
        order = np.lexsort((self.image2, self.image1))
        return self if np.array_equal(order, np.arange(len(self))) else self._rows(order)

    def _rows(self, rows: np.ndarray) -> ViewGraph:
        counts = self.num_inliers()[rows]
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        of_match = np.arange(offsets[-1]) + np.repeat(self.match_offsets[rows] - offsets[:-1], counts)
        return ViewGraph(
            self.image1[rows],
            self.image2[rows],
            self.kind[rows],
            self.num_putative[rows],
            offsets,
            self.keypoint1[of_match],
            self.keypoint2[of_match],
            self.cam2_from_cam1[rows],
            self.essential[rows],
            self.fundamental[rows],
            self.homography[rows],
            self.median_angle_rad[rows],
        )

    def joined(self, other: ViewGraph) -> ViewGraph:
        """The pairs of both, those of `other` last."""
        a, b = self, other
        return ViewGraph(
            np.concatenate([a.image1, b.image1]),
            np.concatenate([a.image2, b.image2]),
            np.concatenate([a.kind, b.kind]),
            np.concatenate([a.num_putative, b.num_putative]),
            np.concatenate([a.match_offsets, a.match_offsets[-1] + b.match_offsets[1:]]),
            np.concatenate([a.keypoint1, b.keypoint1]),
            np.concatenate([a.keypoint2, b.keypoint2]),
            Rigid3(
                np.concatenate([a.cam2_from_cam1.rotation, b.cam2_from_cam1.rotation]),
                np.concatenate([a.cam2_from_cam1.translation, b.cam2_from_cam1.translation]),
            ),
            np.concatenate([a.essential, b.essential]),
            np.concatenate([a.fundamental, b.fundamental]),
            np.concatenate([a.homography, b.homography]),
            np.concatenate([a.median_angle_rad, b.median_angle_rad]),
        )

    def __repr__(self) -> str:
        return f"ViewGraph({len(self)} pairs, {len(self.keypoint1)} inlier matches)"
