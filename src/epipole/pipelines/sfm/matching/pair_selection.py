"""The pairs that mapping uses: those that do not contradict the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int32

from epipole._checks import Declared
from epipole.errors import EpipoleError
from epipole.geometry import Rigid3, Rotation3, essential_from_cam2_from_cam1
from epipole.geometry.planes import decompose_homography
from epipole.mapping import check_rotation_cycles
from epipole.pipelines.sfm.config import MapperConfig
from epipole.robust import PairKind
from epipole.scene import Cameras, ViewGraph


@dataclass(frozen=True, slots=True, eq=False)
class ContradictingPairs(Declared):
    """Verified pairs that are not used: their images probably show different things that look alike."""

    view_graph: ViewGraph
    angle_rad: Float64[np.ndarray, " n"]
    """Angle between the pair's rotation and the one that the other pairs imply; NaN if it does not contradict them."""
    is_conflicting: Bool[np.ndarray, " n"]
    """Pairs that hold a model together whose points conflict."""
    conflict_fraction: Float64[np.ndarray, " n"]
    """Fraction of conflicts of these pairs in the model; NaN if unknown."""

    def reason(self, pair: int) -> str:
        """What the pair contradicts, for people."""
        if not self.is_conflicting[pair]:
            return f"rotation off by {np.degrees(self.angle_rad[pair]):.0f}°"
        share = self.conflict_fraction[pair]
        if np.isnan(share):
            return "its images belong to groups whose points conflict"
        return f"{100 * share:.0f} % of the points conflict"

    def __len__(self) -> int:
        return len(self.view_graph)

    def __repr__(self) -> str:
        return f"ContradictingPairs({len(self)} pairs)"


def consistent_pairs(
    view_graph: ViewGraph,
    keypoints: Sequence[np.ndarray],
    cameras: Cameras,
    camera_of_image: Int32[np.ndarray, " i"],
    config: MapperConfig,
) -> tuple[ViewGraph, Float64[np.ndarray, " n"]]:
    """The pairs that do not contradict the others, and for each pair that does, by which angle in radians; NaN for those that do not.

    A pair with a guessed focal length has no rotation to compare, and stays. A plane allows two motions; if the pair has the
    one that contradicts the others, it gets the other one.

    Args:
        view_graph: verified pairs.
        keypoints: (k, 2) pixels of each image.
        cameras: intrinsics.
        camera_of_image: row of `cameras` of each image.
        config: options.
    """
    is_calibrated = view_graph.kind != PairKind.UNCALIBRATED
    limit_rad = np.deg2rad(config.max_contradiction_deg)
    consistency = check_rotation_cycles(view_graph, len(keypoints), is_calibrated, limit_rad)
    dropped = consistency.contradicts.copy()
    motions = view_graph.cam2_from_cam1
    rotation, translation, essential = (
        motions.rotation.copy(),
        motions.translation.copy(),
        view_graph.essential.copy(),
    )
    for pair in np.flatnonzero(dropped & (view_graph.kind == PairKind.PLANAR)):
        i, j = int(view_graph.image1[pair]), int(view_graph.image2[pair])
        rows = view_graph.keypoint1[view_graph.match_offsets[pair] : view_graph.match_offsets[pair + 1]]
        K1, K2 = (cameras[int(camera_of_image[image])].K for image in (i, j))
        expected = consistency.cams_from_world[j] @ consistency.cams_from_world[i].T
        other = _plane_motion(view_graph.homography[pair], K1, K2, keypoints[i][rows], expected)
        if other is not None and Rotation3(other.rotation @ expected.T).angle_rad() <= limit_rad:
            rotation[pair], translation[pair] = other.rotation, other.translation
            essential[pair] = essential_from_cam2_from_cam1(other)
            dropped[pair] = False
    chosen = replace(view_graph, cam2_from_cam1=Rigid3(rotation, translation), essential=essential)
    return chosen.select(~dropped), np.where(dropped, consistency.angle_rad, np.nan)


def _plane_motion(
    homography: np.ndarray, K1: np.ndarray, K2: np.ndarray, pixels1: np.ndarray, expected: np.ndarray
) -> Rigid3 | None:
    """The motion of a homography whose rotation is nearest the expected one, with |t| = 1; None if there is none."""
    try:
        motions = decompose_homography(homography, K1, K2, pixels1).cam2_from_cam1
    except EpipoleError:
        return None
    lengths = np.linalg.norm(motions.translation, axis=1)
    usable = np.flatnonzero(lengths > 0)
    if not len(usable):
        return None
    angles = Rotation3(motions.rotation[usable] @ expected.T).angle_rad()
    best = usable[int(np.argmin(angles))]
    return Rigid3(motions.rotation[best], motions.translation[best] / lengths[best])
