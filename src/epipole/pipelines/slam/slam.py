"""SLAM in one class: `track` estimates the pose of a frame and extends the map."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from epipole._checks import checked
from epipole.geometry import Rigid3, Similarity3
from epipole.mapping import RefinedPose
from epipole.pipelines.slam.frames import Frame, TrackedFrame, TrackingState
from epipole.pipelines.slam.loops.recognition import describe_keyframe
from epipole.pipelines.slam.map.covariance import own_covariance
from epipole.pipelines.slam.map.local_mapping import LAST_STEPS
from epipole.pipelines.slam.map.past_poses import refine_past_poses
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.slam_mapping import SlamMapping
from epipole.pipelines.slam.start.bootstrap import bootstrap_map
from epipole.pipelines.slam.start.one_camera import Initialization, initialize_map
from epipole.pipelines.slam.start.provisional import Agreement, ProvisionalMap
from epipole.pipelines.slam.start.rig_start import RigStart
from epipole.pipelines.slam.start.rotation import RotationEstimate, RotationTracker
from epipole.pipelines.slam.start.two_view import Confirmation
from epipole.pipelines.slam.tracking.points import Tracks
from epipole.pipelines.slam.warm_up import warm_up, warm_up_imu
from epipole.scene import CameraRig

LEAST_KEYFRAMES = 3
"""A separate map with fewer keyframes is discarded when the camera is lost again."""


class Slam(SlamMapping):
    """Tracks a camera frame by frame and builds a map; unless a thread maps, results do not depend on the machine's load.

    The world is the first frame's camera (only approximately with one camera, whose map is not fixed to it). Its unit is the
    meter if the camera measures depth, else the median depth of the first points. A lost camera is relocalized; meanwhile a
    separate map is started, which a loop closure joins to the first. With one camera, pure rotation yields only orientation.
    """

    @checked
    def track(self, frame: Frame) -> TrackedFrame:
        """Estimate the camera pose of the next frame.

        Raises:
            ShapeError: the images do not have the camera's size.
            ConfigError: the frame is not later than the previous one, or lacks the right image or depth.
        """
        frame = self.camera.checked(frame, self._time_s)
        self._take_over_mapping()
        self._quality = self._quality_monitor.assess(frame)
        if not self.map.num_points:
            answer = self._initialize(frame)
        elif self.state in (TrackingState.LOST, TrackingState.ROTATING, TrackingState.INERTIAL):
            answer = self._find_pose(frame)
        else:
            answer = self._track(frame)
        self._before, self._time_s = frame, frame.timestamp_s
        self._num_frames += 1
        return self._quality.with_quality(self._with_warnings(answer))

    def warm_up(self) -> None:
        """Compile every kernel, or load it from disk, before the first frame, so that no frame waits for that.

        It takes seconds once per process, and a minute or two on a new machine. This object does not change.
        """
        warm_up(self.camera, lambda camera: Slam(camera, self._given_config))
        if self.camera_imu is not None:
            warm_up_imu()

    # Initialization.

    def _initialize(self, frame: Frame) -> TrackedFrame:
        """Initialize a map from this frame if it measures depth, else from it and earlier frames."""
        rig = self.camera.rig
        if not self.camera.measures_depth:
            return self._wait(frame) if rig is None else self._wait_for_rig(frame, rig)
        self.odometry.cam_from_world = Rigid3.identity()
        self.odometry.tracker.tracks = Tracks.none()
        self.odometry.insert_keyframe(frame, self._num_frames)
        if self.map.is_triangulated(self.odometry.tracker.tracks.point).sum() >= self.config.min_tracked:
            return self._initialized(frame, np.zeros((6, 6)))
        self.map.clear()
        self.odometry.tracker.tracks = Tracks.none()
        if rig is not None:  # its cameras with a common view may be covered, or the scene too far for them
            return self._wait_for_rig(frame, rig)
        return self._no_pose(frame, "too few points with depth: blank or dark image, or nothing in range")

    def _wait(self, frame: Frame) -> TrackedFrame:
        """One camera: initialize a map once it has moved enough; before that, track a pure rotation."""
        initial = self._start.add(frame, self._num_frames, self._quality.problem)
        if not isinstance(initial, str):
            return self._start_with_one_camera(frame, initial)
        rotated = self._track_rotation(frame)
        if rotated is not None:
            return self._rotated(frame, rotated, initial)
        self.state = TrackingState.STARTING if self.map is self.maps[0] else self.state
        return self._no_pose(frame, initial, len(self._start.tracks))

    def _wait_for_rig(self, frame: Frame, rig: CameraRig) -> TrackedFrame:
        """Too few points that two cameras see together: initialize a map once the cameras' motions show its scale."""
        if self._rig_start is None:
            self._rig_start = RigStart(rig, lambda camera: Slam(camera, self._given_config))
        initial = self._rig_start.add(frame, self._num_frames)
        if isinstance(initial, str):
            self.state = TrackingState.STARTING if self.map is self.maps[0] else self.state
            return self._no_pose(frame, initial, 0)
        self._rig_start = None
        if self.map is self.maps[0]:
            self.first_frame = initial.model.keyframes[0].number
        self.map.absorb(initial.model)
        for number, time_s, position in initial.frames:
            before = [k for k in self.map.keyframes if k.number <= number]
            keyframe = before[-1] if before else self.map.keyframes[0]
            self._path.add(number, time_s, keyframe, position, np.zeros((6, 6)))
        self.odometry.cam_from_world = initial.frames[-1][2]
        self.odometry.insert_keyframe(frame, self._num_frames)
        self.odometry.mapper.adjust_start()
        self.odometry.cam_from_world = self.map.keyframes[-1].cam_from_world
        return self._initialized(frame, np.zeros((6, 6)))

    def _start_with_one_camera(self, frame: Frame, initial: Initialization) -> TrackedFrame:
        """Add a monocular map, in the world of a preceding pure rotation if the map's first frame is part of it."""
        first, camera = initial.model.keyframes[0], self.camera.camera
        there, position = self._rotations.get(first.number), initial.cam_from_world
        if self.map is self.maps[0]:
            if there is None:
                self.first_frame, self.map.keyframes[:] = first.number, []
            else:
                initial.model.move(Similarity3(np.array(1.0), there.rotation.T, np.zeros(3)))
                position = position @ there
            self.map.keyframes[:] = [k for k in self.map.keyframes if k.number < first.number]
        self.map.absorb(initial.model)
        self.odometry.tracker.tracks, self.odometry.cam_from_world = initial.tracks, position
        self.odometry.insert_keyframe(frame, self._num_frames)
        for with_quality in bootstrap_map(self.odometry.mapper, initial):
            self._path.add(*with_quality)
        now = self.map.keyframes[-1]
        self.odometry.cam_from_world = now.cam_from_world
        here = initialize_map(self.map, now.point, now.pixels, now.cam_from_world, camera, self.config)
        # A rolling shutter displaces the points, and the check does not model it.
        self._unconfirmed = None if self.camera.shutter.is_rolling else self._start
        self._start, self._rotations = self._one_camera_start(), {}
        return self._initialized(frame, np.full((6, 6), np.inf) if here is None else here.covariance())

    def _initialized(self, frame: Frame, covariance: np.ndarray) -> TrackedFrame:
        for keyframe in (k for k in self.map.keyframes if len(k.point)):
            describe_keyframe(keyframe)
        self._set_tracking()
        count = int(self.map.is_triangulated(self.odometry.tracker.tracks.point).sum())
        reason = "the map was initialized" if self.map is self.maps[0] else "a separate map was initialized"
        return self._relative_to(self.odometry.newest_keyframe(), frame, covariance, count, reason)

    # Tracking.

    def _track(self, frame: Frame) -> TrackedFrame:
        """Track the points, estimate the pose and extend the map."""
        assert self._before is not None
        num_points = self.odometry.tracker.choice.num_points
        tracked = self.odometry.track(self._before, frame)
        found = self._quality.confirmed(tracked, num_points, self.config)
        if found is None:
            return self._find_pose(frame)
        if self._is_refuted(frame, found[0].cam_from_world):
            return self._start_again(frame)
        return self._localized(frame, *found)

    def _is_refuted(self, frame: Frame, cam_from_world: Rigid3) -> bool:
        """Whether later frames contradict the initialization of a monocular map."""
        start = self._unconfirmed
        if start is None:
            return False
        first = next((k for k in self.map.keyframes if k.number == start.first_number), None)
        with_quality = Confirmation.OUT_OF_SIGHT
        if first is not None:
            moved = cam_from_world @ first.cam_from_world.inverse()
            with_quality = start.confirm(frame, self._num_frames, moved)
        if with_quality is Confirmation.OUT_OF_SIGHT:
            if self._is_refuted_late():
                return True
            self._leave_unconfirmed()
        elif with_quality is not Confirmation.OPEN:
            self._unconfirmed = None
        return with_quality is Confirmation.REFUTED

    def _start_again(self, frame: Frame) -> TrackedFrame:
        """Discard a map that was initialized wrongly, with the poses of its frames, and initialize again."""
        if self.mapping_thread is not None:
            self.mapping_thread.discard()
        first = self.map.keyframes[0].timestamp_s
        self.start_warnings.append(
            f"the map initialized at {first:.2f} s was discarded at {frame.timestamp_s:.2f} s: later frames contradict it"
        )
        self._closer.clear()
        self._path.clear(self.map.keyframes)
        if self.map is self.maps[0]:
            self.map.clear()
            self.map.number, self._num_maps = self._num_maps, self._num_maps + 1
            self._enter(self.map)
            self.odometry.cam_from_world, self.state = Rigid3.identity(), TrackingState.STARTING
            return self._initialize(frame)
        self.maps.remove(self.map)
        self._enter(self.maps[0])
        self.state = TrackingState.LOST
        return self._find_pose(frame)

    def _localized(self, frame: Frame, refined: RefinedPose, num_agreeing: int) -> TrackedFrame:
        """Process a frame with a known pose: extend the map, close loops, refine past poses and cull."""
        known = frame, refined, num_agreeing, self._num_frames, self._quality
        reason, thread = "", self.mapping_thread
        if self.is_map_fixed:
            self.odometry.stay_in_map(*known)
        else:
            reason = self.odometry.extend_map(*known, is_complete=thread is None)
        if reason and thread is not None:
            thread.search(self.odometry.search_of_points(frame))
            self.odometry.is_incomplete = True
        elif reason:
            self.odometry.optimize_around_newest()
            reason = self._close_loop() or reason
            self._refine_past()
        own = own_covariance(refined, self.map, self._num_frames, measures_depth=self.camera.is_metric)
        return self._relative_to(self.odometry.newest_keyframe(), frame, own, num_agreeing, reason)

    # Relocalization and separate maps.

    def _find_pose(self, frame: Frame) -> TrackedFrame:
        """Relocalize the frame in one of the maps; else track a pure rotation or start a separate map."""
        self.wait_for_mapping(is_urgent=True)
        reason = f"{len(self.odometry.tracker.tracks)} points are tracked, but too few agree with the map"
        carried = self._carry(frame, reason)
        if carried is not None:
            return carried
        if self.state in (TrackingState.TRACKING, TrackingState.SUBMAP, TrackingState.INERTIAL):
            if self._is_refuted_late():
                return self._start_again(frame)
            self._lose()
        if self._quality.is_usable and (found := self._recognized(frame)) is not None:
            return self._localized(frame, *found)
        self._num_lost += 1
        rotated = None if self.camera.is_metric or self.is_map_fixed else self._track_rotation(frame)
        if rotated is not None:
            return self._rotated(frame, rotated, "the camera only rotates: last known position")
        self.state = TrackingState.LOST
        if self._num_lost <= self.config.lost_patience or self.is_map_fixed or not self._quality.is_usable:
            return self._no_pose(frame, reason)
        return self._start_submap(frame, reason)

    def _carry(self, frame: Frame, reason: str) -> TrackedFrame | None:
        """While the image shows nothing of the map: the pose by the IMU, if there is one, for a few seconds."""
        if self.state in (TrackingState.LOST, TrackingState.ROTATING):
            return None
        carried = self.odometry.carry(frame.timestamp_s)
        if self.state is not TrackingState.INERTIAL:
            self._provisional = None
        if carried is None:
            return None
        if self._quality.is_usable:
            entered = self.map, self.odometry
            found = self.odometry.find_carried(frame, *carried) or self._recognized(frame)
            if found is not None:
                self._set_tracking()
                return self._localized(frame, *found)
            self.map, self.odometry = entered
            if self._agrees(frame, *carried):
                return self._continued(frame)
        self.state, self.odometry.cam_from_world = TrackingState.INERTIAL, carried[0]
        newest = self.odometry.newest_keyframe()
        return self._relative_to(newest, frame, carried[1], 0, f"{reason}; the IMU carries the pose")

    def _agrees(self, frame: Frame, carried: Rigid3, covariance: np.ndarray) -> bool:
        """Whether what the camera sees outside the map has moved as the IMU says; then it becomes part of the map."""
        inertial, agreement = self.odometry.inertial, Agreement.REFUTED
        if self.is_map_fixed or not self.camera.measures_depth or inertial is None:
            return False
        if self._provisional is not None:
            agreement = self._provisional[0].add(frame, carried, inertial.velocity_sigma())
        if agreement is Agreement.CONFIRMED and self._provisional is not None:
            self.odometry.join(self._provisional[0].odometry, self._provisional[1])
            self._provisional = None
            return True
        if agreement is Agreement.REFUTED:
            mapper = self.local_mapper(SlamMap(self._num_maps))
            mapper.inertial = None
            mapper.map.right_shift_px = self.map.right_shift_px
            found = ProvisionalMap(mapper, frame, self._num_frames, carried)
            self._provisional = (found, covariance) if found.is_rich else None
        return False

    def _continued(self, frame: Frame) -> TrackedFrame:
        """The map goes on from a keyframe at a carried pose."""
        self._set_tracking()
        keyframe = self.odometry.newest_keyframe()
        describe_keyframe(keyframe)
        count = len(self.odometry.tracker.tracks)
        reason = "the map continues where the IMU has carried the camera"
        return self._relative_to(keyframe, frame, np.zeros((6, 6)), count, reason)

    def _recognized(self, frame: Frame) -> tuple[RefinedPose, int] | None:
        """The pose by similar keyframes, and the number of inliers; enters the map of the pose."""
        for model, again in self._relocalizer.search(frame.gray, self.maps, self.map):
            self._enter(model)
            found = self.odometry.tracker.take_up(frame, again)
            if found is not None:
                self._set_tracking()
                return found
        return None

    def _lose(self) -> None:
        self._closer.clear()
        is_of_this_run = self.map.keyframes[0].number >= self.first_number
        if self.map is not self.maps[0] and is_of_this_run and len(self.map.keyframes) < LEAST_KEYFRAMES:
            self.maps.remove(self.map)
            self._path.clear(self.map.keyframes)
            self._enter(self.maps[0])
            self._unconfirmed = None
        self._leave_unconfirmed()

    def _start_submap(self, frame: Frame, reason: str) -> TrackedFrame:
        known = self.map
        self.maps.append(SlamMap(self._num_maps))
        self._num_maps += 1
        self._enter(self.maps[-1])
        self.map.right_shift_px = known.right_shift_px
        answer = self._initialize(frame)
        if answer.submap_from_body is not None:
            return answer
        self.maps.pop()
        self._num_maps -= 1
        self._enter(known)
        return self._no_pose(frame, f"{reason}; {answer.reason}", answer.num_points)

    # Pure rotation.

    def _track_rotation(self, frame: Frame) -> RotationEstimate | None:
        """Orientation of the frame, if the camera has only rotated since its last known position."""
        if self._rotation is None:
            first = self._first_to_rotate(frame)
            if first is None:
                return None
            number = self._num_frames - int(first is not frame)
            rotation_tracker = RotationTracker(
                first, number, self.camera.camera, self.config, self.odometry.cam_from_world
            )
            if not rotation_tracker.is_rich:
                return None
            self._rotation = rotation_tracker
            if number not in {k.number for k in self.map.keyframes}:
                self.map.keyframes += rotation_tracker.keyframes
            if first is frame:
                none = np.zeros((6, 6))
                return RotationEstimate(
                    rotation_tracker.keyframes[0], self.odometry.cam_from_world, none, 0, is_keyframe=False
                )
        rotated = self._rotation.track(frame, self._num_frames)
        self._rotation = None if rotated is None else self._rotation
        return rotated

    def _first_to_rotate(self, frame: Frame) -> Frame | None:
        """The last frame with a known pose, or the first of a world; None if the rotation would have no reference."""
        if self.map.num_points:
            return self._before if self._num_lost == 1 else None
        if self.map is not self.maps[0] or self._rotations:
            return None
        self.first_frame = self._num_frames
        return frame

    def _rotated(self, frame: Frame, rotated: RotationEstimate, reason: str) -> TrackedFrame:
        self.state, self._num_lost = TrackingState.ROTATING, 0
        self.odometry.cam_from_world = rotated.cam_from_world
        if rotated.is_keyframe:
            self.map.keyframes.append(rotated.keyframe)
        if not self.map.num_points:
            self._rotations[self._num_frames] = rotated.cam_from_world
        return self._relative_to(rotated.keyframe, frame, rotated.covariance, rotated.num_points, reason)

    # Final optimization.

    def finish(self, goes_on: Callable[[int, int], bool] = lambda *_: True) -> None:
        """After the last frame: join maps and connect keyframes that see the same, and optimize all maps; `goes_on(done, of)` may stop it.

        The map with the most frames becomes the first one, unless a known map was given.
        """
        self.wait_for_mapping()
        if self.camera_imu is not None:
            self.camera_imu.is_clock_known(is_last=True)
        self._end_unconfirmed()
        self._largest_first()
        refine_past_poses(self._path, self.odometry.tracker, is_last=True)
        if not self.is_map_fixed:
            self._join_separate_maps(lambda: goes_on(0, LAST_STEPS * len(self.maps)))
            self._largest_first()
        here = self.map, self.odometry
        for number, model in enumerate([] if self.is_map_fixed else self.maps):
            self._enter(model)
            if not self.odometry.mapper.adjust_for_good(number, len(self.maps), goes_on):
                break
        self.map, self.odometry = here
