"""Reading ROS recordings as frames (one camera, a stereo pair, or images with depth) and as IMU logs.

Supports ROS 1 bags (.bag) and ROS 2 bags (a folder with metadata.yaml and .db3 or .mcap files, or one such file), read
with the package `rosbags` (`pip install 'epipole[ros]'`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from epipole._checks import checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, EpipoleError, FileFormatError
from epipole.geometry import Rigid3
from epipole.inertial import ImuLog
from epipole.io._named_numbers import is_rotation
from epipole.io.bags import _images as images
from epipole.io.bags._files import OpenBag, is_bag, opened_bag
from epipole.io.bags._messages import first_message, gray_scale_of, size_of, stamp_s, stamped, topics_of
from epipole.io.bags._pairing import paired
from epipole.io.bags._topics import (
    BagSensor,
    BagTopic,
    base_name,
    choose_topics,
    is_rectified,
    listed_topics,
)
from epipole.io.images.deep_pixels import GrayScale
from epipole.io.sequences.imu_order import in_order
from epipole.io.sequences.imu_units import in_si_units
from epipole.scene import StereoRig

__all__ = ["BagFrame", "BagSequence", "BagTopic", "bag_frames", "is_bag"]
__all__ += ["read_bag", "read_bag_imu", "read_bag_topics"]

PAIR_TOLERANCE_S = 0.005
"""Largest time difference within a stereo pair: cameras are triggered together; drivers add jitter to the stamps."""
DEPTH_TOLERANCE_S = 0.02
"""Largest time difference between color and depth, whose sensors are not synchronized (as in the TUM dataset)."""
GAP_INTERVALS = 5.0
"""Accelerations that are farther apart than this many median intervals are not interpolated."""


@dataclass(frozen=True, slots=True, eq=False)
class BagSequence:
    """The selected topics of a recording and their cameras."""

    path: Path
    sensor: BagSensor
    topics: tuple[str, ...]
    """Topic names: images; left and right; or images and depth."""
    num_frames: int
    """Number of messages of the topic with the fewest."""
    size: tuple[int, int]
    """Width and height of the images."""
    camera: Camera | None
    """None without a CameraInfo."""
    rig: StereoRig | None = None
    """The stereo rig; None without a CameraInfo."""
    depth_camera: Camera | None = None
    """Camera of the depth images; None without a CameraInfo."""
    depth_from_color: Rigid3 | None = None
    """None if depth is registered to the images, or the depth camera's pose is unknown."""
    warnings: tuple[str, ...] = ()
    scales: tuple[GrayScale | None, ...] = ()
    """Conversion of 16-bit images to 8 bits by topic, common to all its images."""
    depth_values_per_m: float | None = None
    """Stored depth values per meter, from the encoding (REP 118); None without depth."""


@dataclass(frozen=True, slots=True, eq=False)
class BagFrame:
    """One frame; images are decoded on access, and raise FileFormatError if damaged."""

    timestamp_s: float
    gray: Callable[[], UInt8[np.ndarray, "h w"]]
    right_gray: Callable[[], UInt8[np.ndarray, "h w"]] | None = None
    depth: Callable[[], Float32[np.ndarray, "h2 w2"]] | None = None
    """Meters; 0 if unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class _Info:
    """The relevant content of a CameraInfo."""

    camera: Camera | None
    frame_id: str
    rectification: np.ndarray
    projection: np.ndarray


@checked
def read_bag_topics(path: str | Path) -> tuple[BagTopic, ...]:
    """The topics of a recording that have messages.

    Raises:
        FileFormatError: the recording is unreadable, or contains no messages.
        MissingDependencyError: the package rosbags is not installed.
    """
    with opened_bag(Path(path)) as bag:
        return topics_of(bag)


@checked
def read_bag(path: str | Path, sensor: str = "auto", topics: Sequence[str] = ()) -> BagSequence:
    """Choose the topics to read, and read their cameras.

    Args:
        path: the recording.
        sensor: mono, stereo or rgbd; auto prefers depth, then a stereo pair.
        topics: names of the image topic; of left and right; or of images and depth. Empty: found by type and name.

    Raises:
        FileFormatError: the recording is unreadable, or has an invalid camera.
        ConfigError: the requested topics do not exist, or the choice is ambiguous.
        MissingDependencyError: the package rosbags is not installed.
    """
    path = Path(path)
    with opened_bag(path) as bag:
        all_topics = topics_of(bag)
        found, names = choose_topics(path, all_topics, sensor, topics)
        firsts = [first_message(bag, name) for name in names]
        infos = [_info_of(bag, name, first, all_topics) for name, first in zip(names, firsts)]
        size = size_of(path, names[0], firsts[0])
        scales = tuple(gray_scale_of(bag, name) for name in names[: 2 if found == "stereo" else 1])
    count = min(t.num_messages for t in all_topics if t.name in names)
    warnings = list(bag.warnings)
    for row, info in enumerate(infos[: 1 if found == "rgbd" else 2]):
        own = size if info is None or info.camera is None else (info.camera.width, info.camera.height)
        if own != size:
            infos[row] = None
            warnings.append(
                f"the CameraInfo of {names[row]} is for {own[0]} x {own[1]} pixels, but its images have "
                f"{size[0]} x {size[1]}, so it is not used"
            )
    camera = None if infos[0] is None else infos[0].camera
    if found == "stereo":
        rig = None if camera is None or infos[1] is None else _rig(path, infos[0], infos[1])
        return BagSequence(
            path, found, names, count, size, camera, rig, warnings=tuple(warnings), scales=scales
        )
    if found == "mono":
        return BagSequence(path, found, names, count, size, camera, warnings=tuple(warnings), scales=scales)
    warnings += _unregistered(names[1], firsts, infos)
    depth_camera = None if infos[1] is None else infos[1].camera
    per_m = images.values_per_meter(images.encoding_of(firsts[1]))
    return BagSequence(
        path,
        found,
        names,
        count,
        size,
        camera,
        depth_camera=depth_camera,
        warnings=tuple(warnings),
        scales=scales,
        depth_values_per_m=per_m,
    )


@checked
def bag_frames(bag: BagSequence) -> Iterator[BagFrame]:
    """The frames of a recording in recorded order, with the stamps from their headers.

    Messages of two topics are paired if nearest in time, within 5 ms for stereo and 20 ms for depth; messages without a
    partner are skipped.

    Raises:
        FileFormatError: the recording is damaged from here on; the frames before are valid.
    """
    with opened_bag(bag.path) as opened:
        rows = ((bag.topics.index(m.topic), *stamped(opened, m)) for m in opened.messages(bag.topics))
        if bag.sensor == "mono":
            for _, time_s, content in rows:
                yield BagFrame(time_s, _gray(bag, 0, content))
            return
        tolerance = PAIR_TOLERANCE_S if bag.sensor == "stereo" else DEPTH_TOLERANCE_S
        for time_s, first, second in paired(rows, tolerance):
            if bag.sensor == "stereo":
                yield BagFrame(time_s, _gray(bag, 0, first), _gray(bag, 1, second))
            else:
                yield BagFrame(time_s, _gray(bag, 0, first), None, _depth(bag, second))


@checked
def read_bag_imu(path: str | Path, topic: str | None = None, units: str = "") -> ImuLog:
    """Read an IMU's measurements (sensor_msgs/Imu), with the stamps from their headers.

    Args:
        path: the recording.
        topic: the IMU's topic, or "GYRO,ACCEL": those of a sensor that publishes the two apart, whose accelerations are interpolated
            at the times of the angular velocities; None if there is only one.
        units: as in `read_imu`.

    Raises:
        FileFormatError: the recording is unreadable, a number is not finite, measurements are in another unit, or the stamps are those
            of several recordings.
        ConfigError: unknown units, there is no such topic, or several and none is chosen.
        MissingDependencyError: the package rosbags is not installed.
    """
    path = Path(path)
    with opened_bag(path) as bag:
        known = [t.name for t in topics_of(bag) if t.kind == "imu"]
        names = known if topic is None else [name.strip() for name in topic.split(",")]
        if topic is None and len(known) > 1:
            problem = (
                "there are several IMUs; choose a topic (imu_topic), or GYRO,ACCEL for a sensor with two"
            )
        elif not names or len(names) > 2 or not {*names} <= {*known}:
            problem = "no IMU topic found" if topic is None else f"no IMU topic found for {topic!r}"
        else:
            problem = ""
        if problem:
            raise ConfigError(f"{path}: {problem} (topics are {listed_topics(topics_of(bag))})")
        tables = [_imu_table(bag, name) for name in names]
    sorted_tables = [in_order(path, values) for values in tables]
    values, notes = sorted_tables[0][0], [note for _, said in sorted_tables for note in said]
    if len(names) == 2:
        values = _with_accelerations(path, values, sorted_tables[1][0])
    gyro, accel, converted = in_si_units(path, values[:, 0], values[:, 1:4], values[:, 4:], units)
    return ImuLog(values[:, 0].copy(), gyro.copy(), accel.copy(), (*notes, *converted))


def _imu_table(bag: OpenBag, name: str) -> np.ndarray:
    """(n, 7) time, angular velocity and acceleration of the messages of a topic.

    Raises:
        FileFormatError: a number is not finite.
    """
    rows = []
    for message in bag.messages([name]):
        content = bag.content(message)
        rotation, acceleration = content.angular_velocity, content.linear_acceleration
        measured = rotation.x, rotation.y, rotation.z, acceleration.x, acceleration.y, acceleration.z
        rows.append((stamp_s(content, message), *measured))
    values = np.array(rows, np.float64).reshape(-1, 7)
    if not np.isfinite(values).all():
        raise FileFormatError(bag.path, f"{name}: a measurement is not finite")
    return values


def _with_accelerations(path: Path, gyro: np.ndarray, accel: np.ndarray) -> np.ndarray:
    """The table of the angular velocities, with the accelerations of another interpolated at its times.

    Angular velocities in gaps of the accelerations are left out, so that the log has the gap, too.

    Raises:
        FileFormatError: the two do not overlap in time.
    """
    times = np.concatenate([[-np.inf], accel[:, 0], [np.inf]])
    sides = [np.searchsorted(times, gyro[:, 0], side) - 1 for side in ("left", "right")]
    between = np.diff(times)[sides].min(axis=0)
    gyro = gyro[between <= GAP_INTERVALS * np.median(np.diff(accel[:, 0]))] if len(accel) > 1 else gyro[:0]
    if len(gyro) < 2:
        raise FileFormatError(path, "angular velocities and accelerations do not overlap in time")
    columns = [np.interp(gyro[:, 0], accel[:, 0], accel[:, axis]) for axis in (4, 5, 6)]
    return np.concatenate([gyro[:, :4], np.stack(columns, axis=1)], axis=1)


def _info_of(bag: OpenBag, topic: str, first: Any, topics: Sequence[BagTopic]) -> _Info | None:
    """The CameraInfo in the namespace of an image topic; else the only one with the same frame_id."""
    names = [t.name for t in topics if t.kind == "camera"]
    beside = f"{base_name(topic).rpartition('/')[0]}/camera_info"
    if beside in names:
        return _info(bag.path, first_message(bag, beside), is_rectified(topic))
    infos = [first_message(bag, name) for name in names]
    own = [message for message in infos if message.header.frame_id == first.header.frame_id]
    return _info(bag.path, own[0], is_rectified(topic)) if len(own) == 1 else None


def _info(path: Path, message: Any, is_flat: bool) -> _Info:
    camera = images.camera_of(path, message, is_rectified=is_flat)
    rotation = np.eye(3) if is_flat else images.field(message, "r").reshape(3, 3)
    projection = images.field(message, "p").reshape(3, 4)
    return _Info(camera, str(message.header.frame_id), rotation, projection)


def _unregistered(depth_topic: str, firsts: Sequence[Any], infos: Sequence[_Info | None]) -> list[str]:
    """A warning if color and depth are in different frames by their CameraInfo or, without both, by the first images."""
    color_frame, depth_frame = (str(first.header.frame_id) for first in firsts)
    if infos[0] is not None and infos[1] is not None:
        color_frame, depth_frame = infos[0].frame_id, infos[1].frame_id
    if any(word in depth_topic for word in ("aligned", "registered")) or color_frame == depth_frame:
        return []
    return [
        f"the depth of {depth_topic} is not registered to the images (its frame is {depth_frame}, theirs {color_frame}); both are"
        " assumed to have the same pose"
    ]


def _rig(path: Path, left: _Info | None, right: _Info | None) -> StereoRig | None:
    """The rig by ROS' convention: x_rectified = R x, and P[0, 3] of the right camera is -f B; None without a baseline."""
    assert left is not None and right is not None
    if left.camera is None or right.camera is None:
        return None
    projections = [left.projection, right.projection]
    if not all(p[0, 0] > 0 and np.isfinite(p).all() for p in projections):
        return None
    if not (is_rotation(left.rectification) and is_rotation(right.rectification)):
        raise FileFormatError(path, "R in the CameraInfo of the pair is not a rotation")
    offset = right.projection[:, 3] / right.projection[0, 0] - left.projection[:, 3] / left.projection[0, 0]
    if not np.abs(offset).max() > 0:
        return None
    right_from_left = Rigid3(right.rectification.T @ left.rectification, right.rectification.T @ offset)
    try:
        return StereoRig(left.camera, right.camera, right_from_left)
    except EpipoleError as error:
        raise FileFormatError(path, f"the CameraInfo of the pair: {error}") from error


def _gray(bag: BagSequence, row: int, content: Any) -> Callable[[], np.ndarray]:
    def read() -> np.ndarray:
        if isinstance(content, FileFormatError):
            raise content
        scale = bag.scales[row] if row < len(bag.scales) else None
        return images.gray_of(bag.path, bag.topics[row], content, scale)

    return read


def _depth(bag: BagSequence, content: Any) -> Callable[[], np.ndarray]:
    def read() -> np.ndarray:
        if isinstance(content, FileFormatError):
            raise content
        return images.depth_of(bag.path, bag.topics[1], content)

    return read
