"""Insertion of keyframes with their tracked, redetected and new points, and with depth if the camera measures it."""

from __future__ import annotations

import numpy as np

from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import OdometryConfig
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.shutter.motion import points_by_depth, shutter_shifts
from epipole.pipelines.slam.tracking.corners import new_corners
from epipole.pipelines.slam.tracking.depth import disparities_of
from epipole.pipelines.slam.tracking.overlap import find_in_other_cameras, match_between_cameras
from epipole.pipelines.slam.tracking.redetection import redetect
from epipole.scene import CameraRig


class KeyframeInserter:
    """Adds keyframes to one map: `find_points` searches an image and only reads the map, `insert` and `complete` extend it."""

    def __init__(
        self, model: SlamMap, sensor: SlamCamera, focal_baseline: float | None, config: OdometryConfig
    ) -> None:
        self.map, self.sensor, self.camera, self.config = model, sensor, sensor.camera_or_rig, config
        self.focal_baseline = focal_baseline
        """Focal length times baseline; None for a single camera."""
        self._stale = np.zeros(0, np.int64)
        """Rows whose reference patches the newest keyframe replaces."""

    def find_points(self, frame: Frame, cam_from_world: Rigid3, tracked: Observations) -> Observations:
        """The tracked points, then redetected ones, then new corners, whose rows are negative; with disparities.

        A new point that two cameras of a rig see has the same negative number in both.

        Args:
            frame: the images.
            cam_from_world: pose of the frame.
            tracked: points in the frame; their disparities are ignored.
        """
        pixels, points = tracked.pixels, tracked.point
        if self.map.keyframes:
            again, rows = redetect(self.map, self.camera, frame.gray, cam_from_world, points)
            used = frame.is_used(again)
            pixels, points = np.concatenate([pixels, again[used]]), np.concatenate([points, rows[used]])
        if isinstance(self.camera, CameraRig):
            others = self._in_other_cameras(self.camera, frame, pixels, points, cam_from_world)
            pixels, points = np.concatenate([pixels, others[0]]), np.concatenate([points, others[1]])
        corners = new_corners(frame.gray, pixels, self.config, frame.ignored_mask, self.camera)
        pixels = np.concatenate([pixels, corners])
        points = np.concatenate([points, -1 - np.arange(len(corners))])
        if isinstance(self.camera, CameraRig):
            points = self._matched(self.camera, frame, pixels, points)
        return Observations(pixels, self._disparities(frame, pixels, points, cam_from_world), points)

    def insert(
        self, frame: Frame, number: int, cam_from_world: Rigid3, seen: Observations, stale: np.ndarray
    ) -> Keyframe:
        """Append a keyframe.

        Args:
            frame: the images.
            number: frame number.
            cam_from_world: pose of the frame.
            seen: its points; negative numbers mark new ones.
            stale: rows of points whose appearance has changed; their reference patches are replaced.
        """
        index = len(self.map.keyframes)
        seen = self._with_rows(seen, index, cam_from_world)
        keyframe = Keyframe(number, frame.timestamp_s, frame.gray, cam_from_world, seen)
        keyframe.motion, keyframe.ignored_mask = self.map.motion, frame.ignored_mask
        keyframe.shift_px = shutter_shifts(self.map, keyframe, keyframe.motion, self.sensor.shutter)
        self.map.keyframes.append(keyframe)
        self._stale = stale
        self._anchor_stale(seen, index)
        return keyframe

    def _anchor_stale(self, seen: Observations, index: int) -> None:
        anew = np.isin(seen.point, self._stale)
        self.map.anchor[seen.point[anew]], self.map.anchor_px[seen.point[anew]] = index, seen.pixels[anew]

    def complete(self, seen: Observations) -> Observations:
        """Replace the observations of the newest keyframe, which had only the tracked points; returns those that were added."""
        keyframe = self.map.keyframes[-1]
        count, index = len(keyframe.point), len(self.map.keyframes) - 1
        seen = self._with_rows(seen, index, keyframe.cam_from_world)
        keyframe.disparity_px = seen.disparity_px[:count]
        added = Observations(*(column[count:] for column in seen))
        keyframe.add(*added)
        self._anchor_stale(added, index)
        return added

    def _with_rows(self, seen: Observations, index: int, cam_from_world: Rigid3) -> Observations:
        """The observations after new points were added to the map; measured depth triangulates those that are not yet."""
        points, fresh = seen.point.copy(), seen.point < 0
        made = self._from_depth(seen, cam_from_world)
        _, first, of_point = np.unique(-points[fresh], return_index=True, return_inverse=True)
        points[fresh] = self.map.add_points(made[fresh][first], seen.pixels[fresh][first], index)[of_point]
        lacking = ~self.map.is_triangulated(points) & ~fresh
        self.map.xyz[points[lacking]] = made[lacking]
        return Observations(seen.pixels, seen.disparity_px, points)

    def _in_other_cameras(
        self, rig: CameraRig, frame: Frame, pixels: np.ndarray, points: np.ndarray, rig_from_world: Rigid3
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pixels and rows of known points in the other cameras of the rig."""
        found = find_in_other_cameras(rig, frame.gray, rig_from_world, pixels, self.map.xyz[points], points)
        used = frame.is_used(found[0])
        return found[0][used], found[1][used]

    def _matched(self, rig: CameraRig, frame: Frame, pixels: np.ndarray, points: np.ndarray) -> np.ndarray:
        """The numbers of the points, with the same one for pixels of two cameras that show the same new point."""
        is_known = np.zeros(len(points), bool)
        is_known[points >= 0] = self.map.is_triangulated(points[points >= 0])
        out, unknown, which = points.copy(), np.flatnonzero(~is_known), rig.camera_of(pixels)
        for one, other in unknown[match_between_cameras(rig, frame.gray, pixels[unknown])]:
            is_seen = (out == out[one]) & (which == which[other])
            if out[other] < 0 and not is_seen.any():  # observations of the map's points come first
                out[other] = out[one]
        return out

    def _disparities(
        self, frame: Frame, pixels: np.ndarray, points: np.ndarray, cam_from_world: Rigid3
    ) -> np.ndarray:
        guess = np.full(len(pixels), np.nan)
        if self.focal_baseline is None:
            return guess
        known = points >= 0
        depth = cam_from_world.apply(self.map.xyz[points[known]])[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            guess[known] = np.where(depth > 0, self.focal_baseline / depth, np.nan) - self.map.right_shift_px
        return disparities_of(frame, pixels, guess, self.sensor, self.config)

    def _from_depth(self, seen: Observations, cam_from_world: Rigid3) -> np.ndarray:
        """(n, 3) points in the world from their disparities; NaN without a disparity, or beyond `max_depth_baselines`."""
        if self.focal_baseline is None:
            return np.full((len(seen.pixels), 3), np.nan)
        most, motion = self.config.max_depth_baselines, self.map.motion
        in_cam = points_by_depth(self.map, seen, motion, self.sensor, self.focal_baseline, most)
        return cam_from_world.inverse().apply(in_cam)
