"""Recording of a run for Foxglove, RViz and other tools of ROS: poses, path, points and images in one MCAP file.

| topic | type | content |
|---|---|---|
| `/tf_static` | tf2_msgs/TFMessage | `map` (x forward, z up) to `world` (that of the poses), and `body` to `camera` |
| `/tf` | tf2_msgs/TFMessage | `world` to `body`, of each frame with a pose |
| `/odometry` | nav_msgs/Odometry | the same pose with its covariance |
| `/path`, `/points` | nav_msgs/Path, sensor_msgs/PointCloud2 | keyframes and map when the run has grown by a tenth; final trajectory |
| `/state` | std_msgs/String | tracking state of each frame, and the reason |
| `/camera/image/compressed`, `/camera/camera_info` | sensor_msgs | the left images, and their camera; of a rig `/camera0/...` and so on |

Poses are those of the moment (the causal trajectory); the last `/path` is the final trajectory. The frame of a separate map is
`world_1` and so on; no transform connects it to the first.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Any, NamedTuple

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.io import ros
from epipole.io.bags.writing import require_writing, written_bag
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackedFrame
from epipole.pipelines.slam.output.scale import upright_axes
from epipole.pipelines.slam.slam import Slam
from epipole.scene import Trajectory

MAP, WORLD, BODY, CAMERA = "map", "world", "body", "camera"
"""Names of the frames."""
GROWTH = 1.1
"""Growth of the trajectory after which path and points are recorded again: all of them together are eleven times the last ones."""
MOST_WAITING = 256
"""Messages that may wait for the disk (three to five per frame); then tracking waits, too."""


class Message(NamedTuple):
    """A message of a recording."""

    topic: str
    kind: str
    stamp_s: float
    fields: dict[str, Any]


class Recording:
    """Records nothing: the recording of a run without one."""

    warnings: tuple[str, ...] = ()
    """Why a recording is not complete."""

    def add(self, system: Slam, frame: Frame, answer: TrackedFrame) -> None:
        """Record a tracked frame."""

    def finish(self, system: Slam) -> None:
        """Record the final trajectory and map."""


class McapRecording(Recording):
    """Records to a file; a thread encodes and writes, while tracking goes on."""

    def __init__(self, path: Path, camera: SlamCamera, body_from_camera: Rigid3) -> None:
        self.path, self._camera, self._body_from_camera = path, camera, body_from_camera
        self._queue: Queue[Any] = Queue(MOST_WAITING)
        self._error: Exception | None = None
        self._has_ended = False
        self._worlds: set[str] = set()
        self._connected: set[str] = set()
        """Worlds with a transform from `map`."""
        self._leveled: set[str] = set()
        """Worlds whose transform from `map` is that of gravity; in the others the first camera is assumed to be level."""
        self._num_poses = self._num_recorded = 0
        self._stamp_s = 0.0
        self._thread: Thread | None = None

    def add(self, system: Slam, frame: Frame, answer: TrackedFrame) -> None:
        """Record a tracked frame: its image, its state and, if known, its pose."""
        self._stamp_s = answer.timestamp_s
        self._put(partial(_of_image, frame, self._camera))
        state = f"{answer.state.value}: {answer.reason}" if answer.reason else answer.state.value
        self._put(lambda: [Message("/state", "std_msgs/msg/String", frame.timestamp_s, {"data": state})])
        if not answer.has_pose:
            return
        world = _world(answer.map_number)
        if world not in self._worlds:
            self._worlds.add(world)
            is_first = answer.world_from_body is not None
            self._connected |= {world} if is_first else set()
            self._put(partial(self._static, answer.timestamp_s, world if is_first else None))
        gravity = system.gravity_in_world if system.map is system.maps[0] else None
        if gravity is not None and world in self._connected - self._leveled:
            self._leveled.add(world)
            axes = upright_axes(system.map, gravity)
            self._put(partial(self._static, answer.timestamp_s, world, axes))
        self._put(partial(_of_pose, answer, self._body_from_camera, world))
        self._num_poses += 1
        if answer.is_keyframe and self._num_poses >= GROWTH * self._num_recorded:
            self._num_recorded = self._num_poses
            self._add_map(system)

    def finish(self, system: Slam) -> None:
        """Record the final trajectory and map, and complete the file."""
        if self._thread is None:
            return
        world, found = _world(system.maps[0].number), system.maps[0].by_imu
        if found is not None and self._worlds:
            axes = upright_axes(system.maps[0], found.gravity_in_world)
            self._put(partial(self._static, self._stamp_s, world, axes))
        elif self._worlds and world not in self._connected:  # another map became the largest
            self._put(partial(self._static, self._stamp_s, world))
        self._add_map(system, system.trajectory())
        self.stop()
        if self._error is not None:
            self.warnings = (f"{self.path} was not recorded: {self._error}",)

    def stop(self) -> None:
        """Write what waits, and complete the file."""
        if self._thread is not None and self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    def _add_map(self, system: Slam, final: Trajectory | None = None) -> None:
        """Record the points and the keyframes, or the final trajectory."""
        model, stamp_s = system.maps[0], self._stamp_s
        keyframes = [(k.timestamp_s, k.cam_from_world) for k in model.keyframes] if final is None else []
        points, world = model.xyz[np.isfinite(model.xyz[:, 0])], _world(model.number)

        def messages() -> list[Message]:
            path = _path_of(keyframes) if final is None else final
            poses = path.world_from_body @ self._body_from_camera.inverse()
            fields = ros.path_fields(path.timestamp_s, poses, world, stamp_s)
            cloud = ros.points_fields(stamp_s, points, world)
            return [
                Message("/path", "nav_msgs/msg/Path", stamp_s, fields),
                Message("/points", "sensor_msgs/msg/PointCloud2", stamp_s, cloud),
            ]

        self._put(messages)

    def _static(
        self, stamp_s: float, world: str | None, axes: np.ndarray = ros.REP103_FROM_OPTICAL
    ) -> list[Message]:
        """The transforms that hardly change; tools keep the last message of a pair of frames.

        Args:
            stamp_s: time.
            world: name of the world that is connected to `map`; None for none.
            axes: (3, 3) rotation from that world into one with x forward and z up.
        """
        transforms = [
            ros.transform_fields(stamp_s, self._body_from_camera @ pose, BODY, name)
            for name, _, pose in _cameras_of(self._camera)
        ]
        if world is not None:
            map_from_world = Rigid3(axes, np.zeros(3))
            transforms.append(ros.transform_fields(stamp_s, map_from_world, MAP, world))
        return [Message("/tf_static", "tf2_msgs/msg/TFMessage", stamp_s, {"transforms": transforms})]

    def _put(self, messages: Any) -> None:
        """Let the thread write what a function returns; it starts, and opens the file, with the first."""
        if self._thread is None:
            self._thread = Thread(target=self._write, name="epipole-record", daemon=True)
            self._thread.start()
        if self._error is None:
            self._queue.put(messages)

    def _write(self) -> None:
        try:
            with written_bag(self.path) as bag:
                while (messages := self._queue.get()) is not None:
                    for message in messages():
                        bag.write(*message)
                self._has_ended = True
        except Exception as error:  # noqa: BLE001 - a thread has no caller; `finish` reports it
            self._error = error
            while not self._has_ended:  # nobody may wait for room
                self._has_ended = self._queue.get() is None


@contextmanager
def open_recording(path: Path | None, camera: SlamCamera, body_from_camera: Rigid3) -> Iterator[Recording]:
    """Open the recording of a run; without a path, one that records nothing. What was recorded is kept if the run fails.

    Raises:
        ConfigError: the name does not end with .mcap.
        MissingDependencyError: the package rosbags is not installed.
    """
    if path is None:
        yield Recording()
        return
    require_writing(path)
    recording = McapRecording(path, camera, body_from_camera)
    try:
        yield recording
    finally:
        recording.stop()


def _world(map_number: int) -> str:
    return WORLD if map_number == 0 else f"{WORLD}_{map_number}"


def _path_of(keyframes: list[tuple[float, Rigid3]]) -> Trajectory:
    poses = [cam_from_world.inverse() for _, cam_from_world in keyframes]
    return Trajectory(
        np.array([time for time, _ in keyframes], np.float64),
        Rigid3(
            np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3),
            np.array([pose.translation for pose in poses]).reshape(-1, 3),
        ),
    )


def _cameras_of(camera: SlamCamera) -> list[tuple[str, Camera, Rigid3]]:
    """Name, intrinsics and pose in the tracked frame of the camera, or of each camera of a rig."""
    if camera.rig is None:
        return [(CAMERA, camera.camera, Rigid3.identity())]
    poses = camera.rig.cam_from_rig.inverse()
    return [(f"{CAMERA}{k}", one, poses[k]) for k, one in enumerate(camera.rig.cameras)]


def _of_image(frame: Frame, camera: SlamCamera) -> list[Message]:
    stamp_s, out = frame.timestamp_s, []
    kinds = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo")
    images = [frame.gray] if camera.rig is None else camera.rig.parts(frame.gray)
    for image, (name, one, _) in zip(images, _cameras_of(camera), strict=True):
        jpeg = ros.jpeg_fields(stamp_s, np.ascontiguousarray(image), name)
        out.append(Message(f"/{name}/image/compressed", kinds[0], stamp_s, jpeg))
        info = ros.camera_info_fields(stamp_s, one, name)
        out.append(Message(f"/{name}/camera_info", kinds[1], stamp_s, info))
    return out


def _of_pose(answer: TrackedFrame, body_from_camera: Rigid3, world: str) -> list[Message]:
    world_from_camera = answer.submap_from_body if answer.world_from_body is None else answer.world_from_body
    assert world_from_camera is not None
    world_from_body, covariance = world_from_camera @ body_from_camera.inverse(), answer.covariance
    if covariance is not None and np.isfinite(covariance).all():
        adjoint = body_from_camera.adjoint()
        covariance = adjoint @ covariance @ adjoint.T
    stamp_s = answer.timestamp_s
    transform = ros.transform_fields(stamp_s, world_from_body, world, BODY)
    odometry = ros.odometry_fields(stamp_s, world_from_body, covariance, world, BODY)
    return [
        Message("/tf", "tf2_msgs/msg/TFMessage", stamp_s, {"transforms": [transform]}),
        Message("/odometry", "nav_msgs/msg/Odometry", stamp_s, odometry),
    ]
