"""The map: keyframes and the points that they observe."""

from __future__ import annotations

from copy import copy, deepcopy
from typing import NamedTuple

import numpy as np

from epipole.geometry import Rigid3, Similarity3
from epipole.pipelines.slam.shutter.recent_motion import NO_MOTION, RecentMotion


class Observations(NamedTuple):
    """Points of the map in one image."""

    pixels: np.ndarray  # (n, 2)
    disparity_px: np.ndarray  # (n,); NaN for none
    point: np.ndarray  # (n,) int64, rows of the map's points, without duplicates in an image

    @staticmethod
    def none() -> Observations:
        """No observations."""
        return Observations(np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))


class Keyframe:
    """A frame kept in the map: its image, pose and observations.

    Attributes:
        number: frame number in the sequence.
        timestamp_s: time of the frame.
        gray: gray image.
        cam_from_world: pose, changed by adjustments.
        pixels: (n, 2) observations.
        disparity_px: (n,) their disparities; NaN for none.
        motion: (12,) velocity and acceleration of a camera with a rolling shutter.
        shift_px: (n, 3) correction of pixels and disparities to those of a global shutter; zero for a global shutter.
        point: (n,) rows of the map's points, without duplicates except in different cameras of a rig.
        descriptors: (n, 128) of the observations; zeros if not computed.
        descriptor: global descriptor of the image, for finding similar images; None until computed.
        unit: scale factor applied to the map around the keyframe since it was created.
        ignored_mask: masked pixels, as in `Frame`; None for a map read from a file.
        covariance: (6, 6) of xi = (translation, rotation) in exp(xi) @ cam_from_world; zero if unknown.
    """

    def __init__(
        self, number: int, timestamp_s: float, gray: np.ndarray, cam_from_world: Rigid3, seen: Observations
    ) -> None:
        self.number, self.timestamp_s, self.gray = number, timestamp_s, gray
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
        """(n, 2) pixels corrected to a global shutter."""
        return self.pixels + self.shift_px[:, :2]

    @property
    def straight_disparity_px(self) -> np.ndarray:
        """(n,) disparities corrected to a global shutter."""
        return self.disparity_px + self.shift_px[:, 2]

    def keep(self, mask: np.ndarray) -> None:
        """Remove the other observations."""
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


class ImuAlignment(NamedTuple):
    """What an IMU has shown of a map."""

    gravity_in_world: np.ndarray  # (3,), m / s^2
    meters_per_unit: float
    sigma: float  # of the meters per unit, without that of the accelerometer's gain
    is_adjusted: bool  # together with the images; else only aligned with the keyframes

    def moved(self, new_from_old: Similarity3) -> ImuAlignment:
        """The same after the map has moved."""
        grown = float(new_from_old.scale)
        return ImuAlignment(
            new_from_old.rotation @ self.gravity_in_world,
            self.meters_per_unit / grown,
            self.sigma / grown,
            self.is_adjusted,
        )


class SlamMap:
    """Keyframes and points. A point is NaN until it is seen under a large enough angle to be triangulated."""

    def __init__(self, number: int = 0) -> None:
        self.number = number
        """Of the map, in the order of initialization."""
        self.keyframes: list[Keyframe] = []
        self._xyz = np.empty((4096, 3))
        self._anchor = np.empty(4096, np.int64)
        self._anchor_px = np.empty((4096, 2))
        self._num_agreed = np.empty(4096, np.int64)
        self.num_points = 0
        self.motion, self.recent = NO_MOTION, RecentMotion()
        """Motion of a rolling-shutter camera in the last frame, and before it."""
        self.right_shift_px = 0.0
        """Estimated offset to the right of the second camera's principal point from its calibrated value (stereo pairs)."""
        self.by_imu: ImuAlignment | None = None
        """Gravity and meters per unit; None until an IMU and the trajectory have shown them."""

    @property
    def xyz(self) -> np.ndarray:
        """(p, 3) points in the world; NaN if not triangulated. Writable."""
        return self._xyz[: self.num_points]

    @property
    def anchor(self) -> np.ndarray:
        """(p,) the keyframe in which each point was first seen."""
        return self._anchor[: self.num_points]

    @property
    def anchor_px(self) -> np.ndarray:
        """(p, 2) pixels in that keyframe. Writable, together with `anchor`."""
        return self._anchor_px[: self.num_points]

    @property
    def num_agreed(self) -> np.ndarray:
        """(p,) number of frames in which each point was an inlier of the pose. Writable."""
        return self._num_agreed[: self.num_points]

    def add_points(self, xyz: np.ndarray, pixels: np.ndarray, keyframe: int | np.ndarray) -> np.ndarray:
        """Add points first seen in a keyframe at these pixels; returns their rows."""
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
        """Which of the points are triangulated."""
        return np.isfinite(self.xyz[points, 0])

    def counts(self, keyframes: list[int]) -> np.ndarray:
        """(p,) number of these keyframes that observe each point."""
        out = np.zeros(self.num_points, np.int64)
        for k in keyframes:
            out[self.keyframes[k].point] += 1
        return out

    def num_shared(self, keyframes: list[int]) -> np.ndarray:
        """For every keyframe, the number of triangulated points that it shares with any of these."""
        is_theirs = (self.counts(keyframes) > 0) & np.isfinite(self.xyz[:, 0])
        return np.array([int(is_theirs[k.point].sum()) for k in self.keyframes], np.int64)

    def copied(self) -> SlamMap:
        """An independent copy; images and descriptors, which are never written to, are shared."""
        out = copy(self)
        out.recent = deepcopy(self.recent)
        out.keyframes = [copy(keyframe) for keyframe in self.keyframes]
        for name in ("_xyz", "_anchor", "_anchor_px", "_num_agreed"):
            setattr(out, name, getattr(self, name).copy())
        return out

    def clear(self) -> None:
        """Remove everything."""
        self.keyframes.clear()
        self.motion, self.recent = NO_MOTION, RecentMotion()
        self.num_points, self.by_imu = 0, None

    def rescale(self, factor: float) -> None:
        """Change the unit of the world."""
        self.move(Similarity3(np.array(factor), np.eye(3), np.zeros(3)))

    def move(self, new_from_old: Similarity3) -> None:
        """Transform everything to another world frame."""
        self.xyz[:] = new_from_old.apply(self.xyz)
        grown = np.tile(np.repeat([float(new_from_old.scale), 1.0], 3), 2)
        for keyframe in self.keyframes:
            keyframe.cam_from_world = new_from_old.move_cam_from_source(keyframe.cam_from_world)
            keyframe.unit *= float(new_from_old.scale)
            keyframe.motion = keyframe.motion * grown
        self.motion = self.motion * grown
        self.recent.grow(float(new_from_old.scale))
        self.by_imu = None if self.by_imu is None else self.by_imu.moved(new_from_old)

    def absorb(self, other: SlamMap) -> int:
        """Move keyframes and points of a map in the same coordinates into this one; returns the offset of its points' rows.

        Keyframes stay sorted by frame number: the newest is the last.
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
        """Merge duplicate points and their observations.

        Args:
            gone: (n,) rows to merge, without duplicates and disjoint from `kept`.
            kept: (n,) rows into which they are merged.

        Returns:
            (p,) new row of each point.
        """
        into = np.arange(self.num_points)
        into[gone] = kept
        for keyframe in self.keyframes:
            point = into[keyframe.point]
            moved = point != keyframe.point
            # If a keyframe observes both, the observations of the kept point stay; else those of the first of several merged ones.
            surplus = moved & np.isin(point, point[~moved])
            rest = np.flatnonzero(moved & ~surplus)
            targets, first = np.unique(point[rest], return_index=True)
            chosen = keyframe.point[rest[first]][np.searchsorted(targets, point[rest])]
            surplus[rest] = keyframe.point[rest] != chosen
            keyframe.point = point
            if surplus.any():
                keyframe.keep(~surplus)
        self.xyz[gone] = np.nan
        return into

    def remove_keyframe(self, number: int) -> None:
        """Remove a keyframe; points anchored in it are anchored in another one that observes them, or become NaN."""
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
        """Remove the rows of other points, which no keyframe may observe; returns the new row of each point, -1 if removed."""
        into = np.where(mask, np.cumsum(mask) - 1, -1)
        for name in ("_xyz", "_anchor", "_anchor_px", "_num_agreed"):
            setattr(self, name, getattr(self, name)[: self.num_points][mask].copy())
        self.num_points = int(mask.sum())
        for keyframe in self.keyframes:
            keyframe.point = into[keyframe.point]
        return into

    def __repr__(self) -> str:
        return f"SlamMap({len(self.keyframes)} keyframes, {int(np.isfinite(self.xyz[:, 0]).sum())} points)"
