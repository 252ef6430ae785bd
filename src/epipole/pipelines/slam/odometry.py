"""Visual odometry in one map: `track` estimates the pose of a frame, `extend_map` extends the map with it.

These two methods have one line per step: predict, track points, estimate the pose, triangulate, decide on a keyframe, insert
it, triangulate its points. Then `optimize_around_newest` adjusts the map. Map management (initialization, loss, loops) is in `slam.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import partial

import numpy as np

from epipole.geometry import Rigid3
from epipole.mapping import RefinedPose
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.map.covariance import by_errors, carry_covariance, with_map_error
from epipole.pipelines.slam.map.insertion import KeyframeInserter
from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.pipelines.slam.map.map_copy import Change, world_motion
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations
from epipole.pipelines.slam.map.triangulation import triangulate, triangulate_between_keyframes
from epipole.pipelines.slam.tracking.frame_quality import FrameQuality
from epipole.pipelines.slam.tracking.inertial_tracking import InertialTracking
from epipole.pipelines.slam.tracking.tracker import PointTracker


class Odometry:
    """Tracks a camera in one map.

    Attributes:
        map: keyframes and points.
        cam_from_world: pose of the last frame.
        tracker: the points that are tracked from frame to frame.
        inertial: predicts poses by an IMU; None without one.
        mapper: inserts keyframes and optimizes the map.
        is_mapping_behind: whether only a large loss of points makes a frame a keyframe.
        is_incomplete: whether a thread still searches points of the newest keyframe; until then no frame becomes one.
    """

    def __init__(self, mapper: LocalMapper, cam_from_world: Rigid3) -> None:
        self.map, self.camera, self.config = mapper.map, mapper.sensor, mapper.config
        self.cam_from_world = cam_from_world
        self.tracker = PointTracker(self.map, self.camera, mapper.focal_baseline, self.config)
        self.inserter = KeyframeInserter(self.map, self.camera, mapper.focal_baseline, self.config)
        self.inertial = None if mapper.inertial is None else InertialTracking(mapper.inertial)
        if self.inertial is not None:
            self.tracker.choice.counts_rotation = True
        self.mapper, self.is_mapping_behind, self.is_incomplete = mapper, False, False

    def track(self, previous: Frame, frame: Frame) -> tuple[RefinedPose, int] | None:
        """Pose of a frame and its number of inliers; None if there are too few.

        The prediction is the previous pose, after the rotation that an IMU has measured. Points that slip along edges stay where
        they are predicted, and a constant-velocity prediction would amplify this error from frame to frame.
        """
        before, tracked = self.cam_from_world, self.tracker.tracks.point
        predicted = before
        if self.inertial is not None:
            predicted = self.inertial.rotated(before, previous.timestamp_s, frame.timestamp_s)
        last = self.tracker.track_points(previous, frame, before, predicted)
        found = None if last is None else self.tracker.estimate_pose(frame, predicted, last)
        if found is None:
            found = self.tracker.redetect_points(previous, frame, predicted, tracked)
        return found

    def carry(self, timestamp_s: float) -> tuple[Rigid3, np.ndarray] | None:
        """The pose by the IMU alone, with its covariance relative to the map; None without a trustworthy IMU, or for too long."""
        if self.inertial is None:
            return None
        return self.inertial.carry([k for k in self.map.keyframes if len(k.point)], timestamp_s)

    def find_carried(
        self, frame: Frame, cam_from_world: Rigid3, covariance: np.ndarray
    ) -> tuple[RefinedPose, int] | None:
        """The pose of a frame from points of the map, searched around where a carried pose predicts them."""
        return self.tracker.redetect_near(frame, cam_from_world, covariance)

    def join(self, other: Odometry, covariance: np.ndarray) -> None:
        """Go on in another map of the same world, which becomes part of this one.

        Args:
            other: odometry in the other map, of one keyframe.
            covariance: of the other keyframe's pose relative to this map.
        """
        newest, keyframe = self.newest_keyframe(), other.newest_keyframe()
        between = keyframe.cam_from_world @ newest.cam_from_world.inverse()
        keyframe.covariance = with_map_error(newest.covariance, between, covariance)
        tracks = other.tracker.tracks
        tracks.point = tracks.point + self.map.absorb(other.map)
        self.tracker.start_from(tracks, other.cam_from_world)
        self.cam_from_world = other.cam_from_world

    def extend_map(
        self,
        frame: Frame,
        refined: RefinedPose,
        num_agreeing: int,
        number: int,
        quality: FrameQuality,
        *,
        is_complete: bool = True,
    ) -> str:
        """Triangulate points with the frame and, if the map needs it, insert the frame as a keyframe.

        Args:
            frame: the images.
            refined: pose of the frame.
            num_agreeing: number of inliers.
            number: frame number.
            quality: a frame of low quality does not become a keyframe.
            is_complete: search the keyframe's points; else it has the tracked ones until `complete_keyframe`.

        Returns:
            why the frame became a keyframe; empty if it did not.
        """
        self.cam_from_world = refined.cam_from_world
        self._remember(frame, refined)
        self.tracker.remember(number)
        triangulate_between_keyframes(
            self.map, self.camera, self.config, self.cam_from_world, self.tracker.tracks
        )
        reason = self._why_keyframe(num_agreeing, number, quality)
        if reason:
            self.insert_keyframe(frame, number, is_complete=is_complete)
            carry_covariance(self.map, refined)
            if is_complete and self.camera.rig is None:  # insertion has triangulated a rig's points
                triangulate(self.map, self.camera.camera_or_rig, self.config, len(self.map.keyframes) - 1)
        return reason

    def stay_in_map(
        self, frame: Frame, refined: RefinedPose, num_agreeing: int, number: int, quality: FrameQuality
    ) -> None:
        """Like `extend_map` for a fixed map: instead of inserting a keyframe, track all map points in sight."""
        self.cam_from_world = refined.cam_from_world
        self._remember(frame, refined)
        if self._why_keyframe(num_agreeing, number, quality):
            self.tracker.track_points_in_sight(frame, self.cam_from_world)

    def insert_keyframe(self, frame: Frame, number: int, *, is_complete: bool = True) -> None:
        """Insert the frame as a keyframe at the current pose, with the tracked points, and if complete with all others."""
        seen, stale = self._tracked(frame), self.tracker.stale
        if is_complete:
            seen = self.inserter.find_points(frame, self.cam_from_world, seen)
        keyframe = self.inserter.insert(frame, number, self.cam_from_world, seen, stale)
        if self.camera.rig is not None:
            triangulate(self.map, self.camera.camera_or_rig, self.config, len(self.map.keyframes) - 1)
        self.tracker.start_from_keyframe(keyframe)

    def search_of_points(self, frame: Frame) -> Callable[[], Observations]:
        """The search for all points of the newest keyframe, inserted from this frame; the map must not change meanwhile."""
        return partial(self.inserter.find_points, frame, self.cam_from_world, self._tracked(frame))

    def complete_keyframe(self, seen: Observations, last: Frame | None) -> None:
        """Give the newest keyframe its points, and track the added ones from there to the last frame, if there is one."""
        added = self.inserter.complete(seen)
        if last is not None:
            self.tracker.track_added(added, last, self.cam_from_world)

    def _remember(self, frame: Frame, refined: RefinedPose) -> None:
        if self.inertial is not None:
            self.inertial.remember(frame.timestamp_s, refined.cam_from_world, by_errors(refined))

    def _tracked(self, frame: Frame) -> Observations:
        tracks = self.tracker.tracks
        tracks.keep(frame.is_used(tracks.pixels))
        return Observations(tracks.pixels, np.full(len(tracks), np.nan), tracks.point)

    def optimize_around_newest(self) -> None:
        """Optimize the newest keyframe and those around it, update the pose and stop tracking outliers."""
        before = copy(self.map.keyframes[-1])
        self.mapper.adjust_around(len(self.map.keyframes) - 1)
        self.tracker.remove_outliers()
        self.cam_from_world = self.map.keyframes[-1].cam_from_world
        if self.inertial is not None:
            self.inertial.move(world_motion(before, self.map.keyframes[-1]))

    def take_over(self, change: Change) -> None:
        """Go on in the map after mapping has changed it."""
        self.cam_from_world = change.new_from_old.move_cam_from_source(self.cam_from_world)
        if self.inertial is not None:
            self.inertial.move(change.new_from_old)
        self.tracker.rename(change.into)
        self.tracker.tracks.keep(~np.isin(self.tracker.tracks.point, change.removed))

    def newest_keyframe(self) -> Keyframe:
        """The last keyframe with points, which rotation-only keyframes do not have."""
        return next(k for k in reversed(self.map.keyframes) if len(k.point))

    def _why_keyframe(self, num_agreeing: int, number: int, quality: FrameQuality) -> str:
        if not quality.is_usable or self.is_incomplete:
            return ""
        age = number - self.newest_keyframe().number
        tracker, is_behind = self.tracker, self.is_mapping_behind
        return tracker.choice.reason(
            self.map, tracker.tracks, self.cam_from_world, num_agreeing, age, is_mapping_behind=is_behind
        )
