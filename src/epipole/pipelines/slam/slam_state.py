"""State of SLAM: maps, previous frame, trajectory, and how tracking results are returned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from epipole._checks import checked
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.inertial import ImuLog, MountedImu
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackedFrame, TrackingState
from epipole.pipelines.slam.loops.closing import LoopCloser
from epipole.pipelines.slam.loops.relocalization import Relocalizer
from epipole.pipelines.slam.map.covariance import with_map_error
from epipole.pipelines.slam.map.culling import cull
from epipole.pipelines.slam.map.imu_clock import CameraImu
from epipole.pipelines.slam.map.local_mapping import LocalMapper, focal_baseline_of
from epipole.pipelines.slam.map.past_poses import refine_past_poses
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap
from epipole.pipelines.slam.map.trajectory import Path
from epipole.pipelines.slam.mapping_thread import MappingThread
from epipole.pipelines.slam.odometry import Odometry
from epipole.pipelines.slam.snapshot import Snapshot, snapshot_of
from epipole.pipelines.slam.start.one_camera import OneCameraStart
from epipole.pipelines.slam.start.provisional import ProvisionalMap
from epipole.pipelines.slam.start.rig_start import RigStart
from epipole.pipelines.slam.start.rotation import RotationTracker
from epipole.pipelines.slam.start.two_view import Confirmation
from epipole.pipelines.slam.tracking.frame_quality import FrameQuality, FrameQualityMonitor
from epipole.scene import Trajectory

UNCONFIRMED = "the map's initialization is not confirmed yet"


class SlamState:
    """Attributes of `Slam`, which adds the algorithm.

    Attributes:
        config: options.
        camera: the tracked camera.
        maps: the first map, in whose world results are given, and separate maps that are not joined to it yet.
        map: the map that the camera is tracked in.
        state: tracking state of the last frame.
        loops: all loop candidates and their verdicts.
        start_warnings: warnings about monocular maps whose initialization was contradicted or could not be confirmed.
        mapping_thread: adjusts the map beside tracking; None if every frame waits for it.
        first_number, first_frame: numbers of the first frame (after those of a known map), and of the first in the world.
    """

    @checked
    def __init__(
        self,
        camera: SlamCamera,
        config: SlamConfig | None = None,
        known: SlamMap | Sequence[SlamMap] | None = None,
        *,
        is_map_fixed: bool = False,
        imu: MountedImu | None = None,
        mapping: Literal["inline", "thread"] = "inline",
    ) -> None:
        """Start without a map, or continue in a known one.

        Args:
            camera: the tracked camera.
            config: options.
            known: map from an earlier run, in whose world results are given once the camera is relocalized in it; of several,
                the first. Loop closures join the others to it.
            is_map_fixed: only localize in the known map, without changing it.
            imu: measurements in the frames' clock, which join the optimization, predict rotations, and carry the pose for a few
                seconds without usable images; ignored with a known map. Mounted on the left camera of a pair, or in the rig's frame.
            mapping: "inline" maps a keyframe before `track` returns, and results do not depend on the machine. "thread" maps in a
                thread, for a live camera or a robot: only frames of a lost camera wait for it. Then results depend on the machine's
                speed, and the object cannot be copied.

        Raises:
            ConfigError: a camera with depth is not a pinhole, or is_map_fixed is set without a known map, or mapping is in a thread
                with a rolling shutter, whose correction changes keyframes in every frame.
        """
        maps = _numbered([known] if isinstance(known, SlamMap) else list(known or []))
        if is_map_fixed and not maps:
            raise ConfigError("is_map_fixed=True needs a map: pass known=")
        if mapping == "thread" and camera.shutter.is_rolling:
            raise ConfigError("mapping='thread' needs a global shutter: readout_s must be 0")
        self._given_config = SlamConfig() if config is None else config
        self.config = self._given_config.odometry
        self.camera = camera
        self.camera_imu = None if imu is None or maps else CameraImu(camera.with_imu(imu))
        self.focal_baseline = focal_baseline_of(camera, self.config)
        self.state = TrackingState.LOST if maps else TrackingState.STARTING
        self.is_map_fixed = is_map_fixed
        self.maps: list[SlamMap] = maps or [SlamMap()]
        numbers = [k.number for model in self.maps for k in model.keyframes]
        self.first_number = self.first_frame = 1 + max(numbers, default=-1)
        self._enter(self.maps[0], Rigid3.identity())
        self._closer = LoopCloser(camera.camera_or_rig, self.config, is_metric=camera.is_metric)
        self.loops = self._closer.ledger
        self._relocalizer = Relocalizer(camera.camera_or_rig, self.config)
        self.mapping_thread = MappingThread() if mapping == "thread" and not is_map_fixed else None
        self._start = self._one_camera_start()
        self._rig_start: RigStart | None = None
        self._unconfirmed: OneCameraStart | None = None
        self.start_warnings: list[str] = []
        self._provisional: tuple[ProvisionalMap, np.ndarray] | None = None
        self._rotation: RotationTracker | None = None
        self._rotations: dict[int, Rigid3] = {}
        self._before: Frame | None = None
        self._time_s = -np.inf
        self._quality_monitor, self._quality = FrameQualityMonitor(camera.rig), FrameQuality()
        self._path = Path(self.first_number)
        self._num_frames, self._num_lost, self._num_maps = self.first_number, 0, len(self.maps)

    def _one_camera_start(self) -> OneCameraStart:
        judges = None if self.mapping_thread is None else self.mapping_thread.judges
        return OneCameraStart(self.camera.camera, self.config, judges)

    def _enter(self, model: SlamMap, cam_from_world: Rigid3 | None = None) -> None:
        """Continue in this map from a pose (None: the last one)."""
        pose = self.odometry.cam_from_world if cam_from_world is None else cam_from_world
        self.map = model
        self.odometry: Odometry = Odometry(self.local_mapper(model), pose)

    def local_mapper(self, model: SlamMap) -> LocalMapper:
        """A new local mapper of one of the maps."""
        return LocalMapper(model, self.camera, self.focal_baseline, self.config, self.camera_imu)

    @checked
    def add_imu(self, samples: ImuLog) -> None:
        """Add measurements of a live IMU, before the frames that they cover.

        Args:
            samples: later than those before, by the frames' clock.

        Raises:
            ConfigError: the IMU's mounting is unknown.
            ShapeError: the times do not increase.
        """
        if self.camera_imu is None:
            raise ConfigError(
                "measurements of an IMU need its mounting: pass imu=MountedImu(log, camera_from_imu), with the log so far"
            )
        self.camera_imu.add(samples)

    @property
    def imu(self) -> MountedImu | None:
        """The IMU with its measurements so far; None without one."""
        return None if self.camera_imu is None else self.camera_imu.imu

    @property
    def meters_per_unit(self) -> tuple[float, float] | None:
        """Meters per unit of the tracked map, and the standard deviation.

        (1, 0) if the camera measures lengths. With one camera, None until an IMU and the trajectory have shown it: poses, map and
        their covariances stay in the map's unit, and are to be multiplied.
        """
        if self.camera.is_metric:
            return 1.0, 0.0
        found = self.map.by_imu
        if found is None or self.imu is None:
            return None
        gain = found.meters_per_unit * self.imu.noise.accel_gain_sigma
        return found.meters_per_unit, float(np.hypot(found.sigma, gain))

    @property
    def gravity_in_world(self) -> np.ndarray | None:
        """(3,) gravity in the world of the tracked map, in m / s^2; None until an IMU and the trajectory have shown it."""
        return None if self.map.by_imu is None else self.map.by_imu.gravity_in_world

    def continue_in(self, model: SlamMap, answers: Sequence[TrackedFrame]) -> None:
        """Continue in a map after frames that another process tracked; the camera must be relocalized in it.

        Each frame keeps its motion relative to the last keyframe before it, as estimated when the frame arrived. Frames that
        were tracked in other maps lose their poses.

        Args:
            model: the map; without points if none was saved.
            answers: results of all tracked frames, in order.
        """
        self.maps = [model]
        self._enter(model)
        self._num_maps = 1 + max([model.number, *(answer.map_number for answer in answers)])
        keyframes = {keyframe.number: keyframe for keyframe in model.keyframes}
        reference: tuple[Keyframe, Rigid3] | None = None
        for number, answer in enumerate(answers, self.first_number):
            keyframe, pose = keyframes.get(number), answer.world_from_body
            pose = pose if answer.map_number == model.number else None
            if keyframe is not None:
                reference = keyframe, keyframe.cam_from_world if pose is None else pose.inverse()
            if reference is not None and pose is not None:
                keyframe, then = reference
                cam_from_world = pose.inverse() @ then.inverse() @ keyframe.cam_from_world
                covariance = np.zeros((6, 6)) if answer.covariance is None else answer.covariance
                self._path.add(number, answer.timestamp_s, keyframe, cam_from_world, covariance)
        self._num_frames = self.first_number + len(answers)
        self._time_s = answers[-1].timestamp_s if answers else -np.inf
        if model.num_points:
            self.state, self._num_lost = TrackingState.LOST, 1

    def trajectory(self, number: int = 0) -> Trajectory:
        """Poses of all frames localized in one of the maps (by default the first), from its current state."""
        return self._path.trajectory(self.maps[number].keyframes)

    def snapshot(self) -> Snapshot:
        """Copy of the current map and tracked points, for display."""
        source = self.odometry.tracker if self.map.num_points else self._start
        return snapshot_of(self.map, self.state, source.tracks)

    def _is_refuted_late(self) -> bool:
        """Wait for the verdict on the initialization, if there is one to come; whether later frames contradict it."""
        start = self._unconfirmed
        verdict = Confirmation.OPEN if start is None else start.verdict(wait=True)
        if verdict is not Confirmation.OPEN:
            self._unconfirmed = None
        return verdict is Confirmation.REFUTED

    def _leave_unconfirmed(self) -> None:
        """Report that no later frame can confirm the initialization."""
        if self._unconfirmed is not None:
            self.start_warnings.append(
                f"the map initialized at {self._unconfirmed.first_time_s:.2f} s could not be confirmed: its first points left the"
                " view before the camera had moved far enough"
            )
        self._unconfirmed = None

    def _end_unconfirmed(self) -> None:
        """After the last frame: discard a map whose initialization is contradicted, if there is another one, else report it."""
        if not self._is_refuted_late():
            self._leave_unconfirmed()
            return
        first_s = self.map.keyframes[0].timestamp_s
        words = f"the map initialized at {first_s:.2f} s is contradicted by the last frames that show its first points"
        if len(self.maps) > 1:
            words += ": it was discarded"
            self._path.clear(self.map.keyframes)
            self.maps.remove(self.map)
            self._enter(self.maps[0])
            self.state = TrackingState.LOST
        self.start_warnings.append(words)

    def _largest_first(self) -> None:
        """The map with the most frames becomes the first one, unless a known map was given."""
        if not self.first_number:
            self.maps.sort(key=lambda model: -len(self._path.trajectory(model.keyframes)))

    def _refine_past(self) -> None:
        """Estimate poses of earlier frames again, and cull the map, after its adjustment."""
        refine_past_poses(self._path, self.odometry.tracker)
        cull(self.map, self._path, self.odometry.tracker)

    def _relative_to(
        self, keyframe: Keyframe, frame: Frame, covariance: np.ndarray, num_points: int, reason: str
    ) -> TrackedFrame:
        self._path.add(
            self._num_frames, frame.timestamp_s, keyframe, self.odometry.cam_from_world, covariance
        )
        between = self.odometry.cam_from_world @ keyframe.cam_from_world.inverse()
        covariance = with_map_error(keyframe.covariance, between, covariance)
        position, is_first = self.odometry.cam_from_world.inverse(), self.map is self.maps[0]
        return TrackedFrame(
            frame.timestamp_s,
            self.state,
            reason,
            position if is_first else None,
            covariance,
            num_points,
            is_keyframe=keyframe.number == self._num_frames,
            submap_from_body=None if is_first else position,
            moving=self.odometry.tracker.moving,
            map_number=self.map.number,
        )

    def _no_pose(self, frame: Frame, reason: str, num_points: int | None = None) -> TrackedFrame:
        count = len(self.odometry.tracker.tracks) if num_points is None else num_points
        return TrackedFrame(frame.timestamp_s, self.state, reason, None, None, count, is_keyframe=False)

    def _with_warnings(self, answer: TrackedFrame) -> TrackedFrame:
        """The result with warnings about its pose."""
        if not answer.has_pose:
            return answer
        if self._unconfirmed is not None:
            answer = answer.with_words(UNCONFIRMED)
        static = self.odometry.tracker.static_part
        return answer if static is None else answer.with_words(static.in_words())


def _numbered(maps: list[SlamMap]) -> list[SlamMap]:
    """Number the maps, and increase the frame numbers of later ones that are not unique."""
    used = set[int]()
    for number, model in enumerate(maps):
        model.number = number
        own = {keyframe.number for keyframe in model.keyframes}
        if own & used:
            offset = 1 + max(used) - min(own)
            for keyframe in model.keyframes:
                keyframe.number += offset
            own = {number + offset for number in own}
        used |= own
    return maps
