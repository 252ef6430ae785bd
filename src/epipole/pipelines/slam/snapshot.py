"""Snapshots of a growing map, for display."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from epipole.geometry import Rigid3
from epipole.pipelines.slam.frames import TrackingState
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.tracking.points import Tracks


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Copy of the visible state of a map."""

    state: TrackingState
    world_from_keyframes: Rigid3
    """(k,) poses of the keyframes, in order."""
    points_in_world: Float64[np.ndarray, "p 3"]
    """Triangulated points."""
    tracked_px: Float64[np.ndarray, "n 2"]
    """Points tracked in the last frame."""
    is_triangulated: Bool[np.ndarray, " n"]
    """Which of the tracked points are triangulated."""

    def __repr__(self) -> str:
        return (
            f"Snapshot({self.state.value}, {len(self.world_from_keyframes.rotation)}"
            f" keyframes, {len(self.points_in_world)} points, {len(self.tracked_px)} tracked)"
        )


def snapshot_of(model: SlamMap, state: TrackingState, tracks: Tracks) -> Snapshot:
    """Copy the visible state of a map."""
    keyframes = [keyframe.cam_from_world.inverse() for keyframe in model.keyframes]
    positions = Rigid3(
        np.array([position.rotation for position in keyframes]).reshape(-1, 3, 3),
        np.array([position.translation for position in keyframes]).reshape(-1, 3),
    )
    # Before the map of one camera is initialized, tracked rows do not refer to its points.
    has_started = model.num_points > 0
    known = model.is_triangulated(tracks.point) if has_started else np.zeros(len(tracks), bool)
    points = model.xyz[np.isfinite(model.xyz[:, 0])]
    return Snapshot(state, positions, points, tracks.pixels.copy(), known)
