"""The map: keyframes, and points with the keyframes that saw them; it grows and is adjusted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from epipole.geometry import Rigid3


class Observations(NamedTuple):
    """Points of the map in one picture."""

    pixels: np.ndarray  # (n, 2)
    disparity_px: np.ndarray  # (n,); NaN for none
    point: np.ndarray  # (n,) int64, row of the map's points, each at most once


class Keyframe:
    """A frame that stays: its picture, its place, and what it saw of the map.

    Attributes:
        number: of the frame in the sequence.
        timestamp_s: its time.
        grey: its picture.
        cam_from_world: its place, which adjustments change.
        pixels: (n, 2) of its observations.
        disparity_px: (n,) of them, NaN for none.
        point: (n,) rows of the map's points, each at most once.
    """

    def __init__(
        self, number: int, timestamp_s: float, grey: np.ndarray, cam_from_world: Rigid3, seen: Observations
    ) -> None:
        self.number, self.timestamp_s, self.grey, self.cam_from_world = (
            number,
            timestamp_s,
            grey,
            cam_from_world,
        )
        self.pixels, self.disparity_px, self.point = seen

    def keep(self, mask: np.ndarray) -> None:
        """Forget the other observations."""
        self.pixels, self.disparity_px, self.point = (
            self.pixels[mask],
            self.disparity_px[mask],
            self.point[mask],
        )

    def add(self, pixels: np.ndarray, disparity_px: np.ndarray, point: np.ndarray) -> None:
        """Add observations."""
        self.pixels = np.concatenate([self.pixels, pixels])
        self.disparity_px = np.concatenate([self.disparity_px, disparity_px])
        self.point = np.concatenate([self.point, point])


class SlamMap:
    """Keyframes and points. A point without a place yet (NaN) is one that was seen, but under too narrow an angle."""

    def __init__(self) -> None:
        self.keyframes: list[Keyframe] = []
        self._xyz = np.empty((4096, 3))
        self._anchor = np.empty(4096, np.int64)
        self._anchor_px = np.empty((4096, 2))
        self.num_points = 0

    @property
    def xyz(self) -> np.ndarray:
        """(p, 3) points in the world; NaN without a place. May be written to."""
        return self._xyz[: self.num_points]

    @property
    def anchor(self) -> np.ndarray:
        """(p,) the keyframe in which each point was first seen."""
        return self._anchor[: self.num_points]

    @property
    def anchor_px(self) -> np.ndarray:
        """(p, 2) where in that keyframe. May be written to, with `anchor`."""
        return self._anchor_px[: self.num_points]

    def add_points(self, xyz: np.ndarray, pixels: np.ndarray, keyframe: int) -> np.ndarray:
        """Rows of new points, first seen in a keyframe at these pixels."""
        first, self.num_points = self.num_points, self.num_points + len(xyz)
        if self.num_points > len(self._xyz):
            size = max(self.num_points, 2 * len(self._xyz))
            self._xyz = np.concatenate([self._xyz, np.empty((size - len(self._xyz), 3))])
            self._anchor = np.concatenate([self._anchor, np.empty(size - len(self._anchor), np.int64)])
            self._anchor_px = np.concatenate([self._anchor_px, np.empty((size - len(self._anchor_px), 2))])
        self._xyz[first : self.num_points] = xyz
        self._anchor[first : self.num_points] = keyframe
        self._anchor_px[first : self.num_points] = pixels
        return np.arange(first, self.num_points)

    def has_place(self, points: np.ndarray) -> np.ndarray:
        """Which of the points have a place."""
        return np.isfinite(self.xyz[points, 0])

    def counts(self, keyframes: list[int]) -> np.ndarray:
        """(p,) in how many of these keyframes each point is seen."""
        out = np.zeros(self.num_points, np.int64)
        for k in keyframes:
            out[self.keyframes[k].point] += 1
        return out

    def clear(self) -> None:
        """Forget everything."""
        self.keyframes.clear()
        self.num_points = 0

    def rescale(self, factor: float) -> None:
        """Change the unit of the world."""
        self.xyz[:] *= factor
        for keyframe in self.keyframes:
            place = keyframe.cam_from_world
            keyframe.cam_from_world = Rigid3(place.rotation, place.translation * factor)

    def __repr__(self) -> str:
        return f"SlamMap({len(self.keyframes)} keyframes, {int(np.isfinite(self.xyz[:, 0]).sum())} points)"
