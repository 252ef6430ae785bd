"""The map: keyframes, and points with the keyframes that saw them; it grows, is adjusted, and forgets."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from epipole.geometry import Rigid3, Similarity3
from epipole.pipelines.slam.shutter.recent_motion import NO_MOTION, RecentMotion


class Observations(NamedTuple):
    """Points of the map in one image."""

    pixels: np.ndarray  # (n, 2)
    disparity_px: np.ndarray  # (n,); NaN for none
    point: np.ndarray  # (n,) int64, row of the map's points, each at most once


class Keyframe:
    """A frame that stays: its image, its place, and what it saw of the map.

    Attributes:
        number: of the frame in the sequence.
        timestamp_s: its time.
        grey: its image.
        cam_from_world: its place, which adjustments change.
        pixels: (n, 2) of its observations.
        disparity_px: (n,) of them, NaN for none.
        motion: (12,) the camera's speed and its change, where it has a rolling shutter.
        shift_px: (n, 3) from pixels and disparities to what a shutter of one instant would have seen; zero where it is one.
        point: (n,) rows of the map's points, each at most once.
        descriptors: (n, 128) of them, zeros where none was made.
        look: the whole image as one vector, for finding images that look alike; None before it is made.
        unit: by what lengths around it were multiplied since it was made.
        ignored_mask: where nothing may be seen in its image, as in `Frame`; None of a map that was read from a file.
        covariance: (6, 6) of xi = (translation, rotation) in exp(xi) @ cam_from_world; zero where it is not known.
    """

    def __init__(
        self, number: int, timestamp_s: float, grey: np.ndarray, cam_from_world: Rigid3, seen: Observations
    ) -> None:
        self.number, self.timestamp_s, self.grey = number, timestamp_s, grey
        self.cam_from_world = cam_from_world
        self.pixels, self.disparity_px, self.point = seen
        self.shift_px = np.zeros((len(self.point), 3))
        self.motion = np.zeros(12)
        self.descriptors = np.zeros((len(self.point), 128), np.uint8)
        self.descriptor: np.ndarray | None = None
        self.unit = 1.0
        self.ignored_mask: np.ndarray | None = None
        self.covariance = np.zeros((6, 6))

    @property
    def straight_px(self) -> np.ndarray:
        """(n, 2) where a shutter of one instant would have seen the points."""
        return self.pixels + self.shift_px[:, :2]

    @property
    def straight_disparity_px(self) -> np.ndarray:
        """(n,) disparities that it would have seen."""
        return self.disparity_px + self.shift_px[:, 2]

    def keep(self, mask: np.ndarray) -> None:
        """Forget the other observations."""
        self.pixels, self.disparity_px = self.pixels[mask], self.disparity_px[mask]
        self.point, self.descriptors = self.point[mask], self.descriptors[mask]
        self.shift_px = self.shift_px[mask]

    def add(self, pixels: np.ndarray, disparity_px: np.ndarray, point: np.ndarray) -> None:
        """Add observations."""
        self.pixels = np.concatenate([self.pixels, pixels])
        self.disparity_px = np.concatenate([self.disparity_px, disparity_px])
        self.point = np.concatenate([self.point, point])
        self.shift_px = np.concatenate([self.shift_px, np.zeros((len(point), 3))])
        none = np.zeros((len(point), 128), np.uint8)
        self.descriptors = np.concatenate([self.descriptors, none])


class SlamMap:
    """Keyframes and points. A point without a place yet (NaN) is one that was seen, but under too narrow an angle."""

    def __init__(self, number: int = 0) -> None:
        self.number = number
        """Of the map, in order of initialization."""
        self.keyframes: list[Keyframe] = []
        self._xyz = np.empty((4096, 3))
        self._anchor = np.empty(4096, np.int64)
        self._anchor_px = np.empty((4096, 2))
        self._num_agreed = np.empty(4096, np.int64)
        self.num_points = 0
        self.motion, self.recent = NO_MOTION, RecentMotion()
        """Of the camera in the last frame, and before it, where it has a rolling shutter."""
        self.right_shift_px = 0.0
        """By how much further to the right than it was said the principal point of a pair's second camera lies."""

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

    @property
    def num_agreed(self) -> np.ndarray:
        """(p,) in how many frames each point was where the others foretold it. May be written to."""
        return self._num_agreed[: self.num_points]

    def add_points(self, xyz: np.ndarray, pixels: np.ndarray, keyframe: int | np.ndarray) -> np.ndarray:
        """Rows of new points, first seen in a keyframe at these pixels."""
        first, self.num_points = self.num_points, self.num_points + len(xyz)
        if self.num_points > len(self._xyz):
            more = max(self.num_points, 2 * len(self._xyz)) - len(self._xyz)
            for name in ("_xyz", "_anchor", "_anchor_px", "_num_agreed"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.empty((more, *old.shape[1:]), old.dtype)]))
        self._xyz[first : self.num_points] = xyz
        self._anchor[first : self.num_points] = keyframe
        self._anchor_px[first : self.num_points] = pixels
        self._num_agreed[first : self.num_points] = 0
        return np.arange(first, self.num_points)

    def is_triangulated(self, points: np.ndarray) -> np.ndarray:
        """Which of the points have a place."""
        return np.isfinite(self.xyz[points, 0])

    def counts(self, keyframes: list[int]) -> np.ndarray:
        """(p,) in how many of these keyframes each point is seen."""
        out = np.zeros(self.num_points, np.int64)
        for k in keyframes:
            out[self.keyframes[k].point] += 1
        return out

    def num_shared(self, keyframes: list[int]) -> np.ndarray:
        """Of every keyframe, how many placed points it shares with any of these."""
        is_theirs = (self.counts(keyframes) > 0) & np.isfinite(self.xyz[:, 0])
        return np.array([int(is_theirs[k.point].sum()) for k in self.keyframes], np.int64)

    def clear(self) -> None:
        """Forget everything."""
        self.keyframes.clear()
        self.motion, self.recent = NO_MOTION, RecentMotion()
        self.num_points = 0

    def rescale(self, factor: float) -> None:
        """Change the unit of the world."""
        self.move(Similarity3(np.array(factor), np.eye(3), np.zeros(3)))

    def move(self, new_from_old: Similarity3) -> None:
        """Tell everything in another world's coordinates."""
        self.xyz[:] = new_from_old.apply(self.xyz)
        grown = np.tile(np.repeat([float(new_from_old.scale), 1.0], 3), 2)
        for keyframe in self.keyframes:
            keyframe.cam_from_world = new_from_old.move_cam_from_source(keyframe.cam_from_world)
            keyframe.unit *= float(new_from_old.scale)
            keyframe.motion = keyframe.motion * grown
        self.motion = self.motion * grown
        self.recent.grow(float(new_from_old.scale))

    def absorb(self, other: SlamMap) -> int:
        """Take over keyframes and points of a map in the same coordinates; returns what to add to its points' rows.

        Keyframes stay in the order of their frames, so that the newest is the last.
        """
        offset, before = self.num_points, len(self.keyframes)
        rows = self.add_points(other.xyz, other.anchor_px, other.anchor + before)
        self.num_agreed[rows] = other.num_agreed
        for keyframe in other.keyframes:
            keyframe.point = keyframe.point + offset
        both = self.keyframes + other.keyframes
        order = np.argsort([keyframe.number for keyframe in both], kind="stable")
        self.keyframes = [both[k] for k in order]
        self.anchor[:] = np.argsort(order)[self.anchor]
        other.keyframes, other.num_points = [], 0
        return offset

    def merge_points(self, gone: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Points that are the same thing become one, with the observations of both.

        Args:
            gone: (n,) rows, each at most once and none of them in `kept`.
            kept: (n,) rows that they become.

        Returns:
            (p,) what each row has become.
        """
        into = np.arange(self.num_points)
        into[gone] = kept
        for keyframe in self.keyframes:
            point = into[keyframe.point]
            # Where a keyframe saw both, the observation that was the kept point's already stays.
            order = np.lexsort((point != keyframe.point, point))
            first = np.ones(len(point), bool)
            first[order[1:]] = point[order[1:]] != point[order[:-1]]
            keyframe.point = point
            if not first.all():
                keyframe.keep(first)
        self.xyz[gone] = np.nan
        return into

    def remove_keyframe(self, number: int) -> None:
        """Take a keyframe out; points that were first seen in it are known by another one that sees them, or are gone."""
        gone = self.keyframes.pop(number)
        orphans = self.anchor == number
        self.anchor[self.anchor > number] -= 1
        for k, keyframe in enumerate(self.keyframes):
            rows = np.flatnonzero(orphans[keyframe.point])
            points = keyframe.point[rows]
            self.anchor[points], self.anchor_px[points] = k, keyframe.pixels[rows]
            orphans[points] = False
        self.xyz[orphans] = np.nan
        self.anchor[orphans] = 0
        gone.keep(np.zeros(len(gone.point), bool))

    def keep_points(self, mask: np.ndarray) -> np.ndarray:
        """Give up the rows of other points, which no keyframe may see; returns what each row has become, -1 for gone."""
        into = np.where(mask, np.cumsum(mask) - 1, -1)
        for name in ("_xyz", "_anchor", "_anchor_px", "_num_agreed"):
            setattr(self, name, getattr(self, name)[: self.num_points][mask].copy())
        self.num_points = int(mask.sum())
        for keyframe in self.keyframes:
            keyframe.point = into[keyframe.point]
        return into

    def __repr__(self) -> str:
        return f"SlamMap({len(self.keyframes)} keyframes, {int(np.isfinite(self.xyz[:, 0]).sum())} points)"
