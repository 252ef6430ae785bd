"""A copy of the map, which mapping changes while tracking extends the original, and how its result is taken over."""

from __future__ import annotations

from copy import copy
from typing import NamedTuple

import numpy as np

from epipole.geometry import Rotation3, Similarity3
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap

OF_MAPPING = (
    "cam_from_world",
    "pixels",
    "disparity_px",
    "point",
    "shift_px",
    "descriptors",
    "descriptor",
    "unit",
    "covariance",
)
"""Attributes of a keyframe that mapping changes."""


class Change(NamedTuple):
    """What tracking must change when a map is replaced."""

    new_from_old: Similarity3
    """Motion of the world, as seen from the newest keyframe of the copy."""
    into: np.ndarray
    """(p,) new row of each point."""
    removed: np.ndarray
    """Rows of the points whose observations in that keyframe were removed as outliers."""


class MapCopy:
    """A copy of a map; until it replaces the original, that may only grow: by keyframes, points, and depths of points.

    Attributes:
        original: the map that tracking uses.
        map: the copy, with the same indices of keyframes and rows of points.
        into: (p,) row with which each point of the copy was merged.
    """

    def __init__(self, original: SlamMap) -> None:
        self.original, self.map = original, original.copied()
        self.into = np.arange(original.num_points)
        self._originals = list(original.keyframes)
        self._newest = copy(original.keyframes[-1])
        self._lacked_depth = np.isnan(original.xyz[:, 0])

    def replace_original(self) -> Change:
        """Give the original the state of the copy; what tracking has added meanwhile moves with the copy's newest keyframe."""
        model, made, count = self.original, self.map, len(self._lacked_depth)
        newest = made.keyframes[-1]
        moved = world_motion(self._newest, newest)
        for own, changed in zip(self._originals, made.keyframes):
            for name in OF_MAPPING:
                setattr(own, name, getattr(changed, name))
        for keyframe in model.keyframes[len(self._originals) :]:
            keyframe.cam_from_world = moved.move_cam_from_source(keyframe.cam_from_world)
            keyframe.unit *= float(moved.scale)
        carried = moved.apply(model.xyz)
        triangulated = self._lacked_depth & np.isnan(made.xyz[:, 0])
        model.xyz[:count] = np.where(triangulated[:, None], carried[:count], made.xyz)
        model.xyz[count:] = carried[count:]
        model.right_shift_px, model.by_imu = made.right_shift_px, made.by_imu
        into = np.concatenate([self.into, np.arange(count, model.num_points)])
        gone = np.flatnonzero(into != np.arange(len(into)))
        if len(gone):
            model.merge_points(gone, into[gone])
        return Change(moved, into, np.setdiff1d(into[self._newest.point], newest.point))


def world_motion(before: Keyframe, after: Keyframe) -> Similarity3:
    """The motion of the world that keeps a keyframe's view unchanged when its pose and its unit have changed."""
    scale = after.unit / before.unit
    world_from_cam, old = after.cam_from_world.inverse(), before.cam_from_world
    # Rounding errors of rotations would grow from one replacement to the next.
    rotation = Rotation3.nearest(world_from_cam.rotation @ old.rotation).matrix
    return Similarity3(
        np.array(scale),
        rotation,
        world_from_cam.rotation @ (scale * old.translation) + world_from_cam.translation,
    )
