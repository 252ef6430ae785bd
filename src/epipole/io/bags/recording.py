"""Recordings of ROS as frames: one camera, a pair, or images with depth; and what an IMU measured.

ROS 1 bags (.bag), ROS 2 bags (a folder with metadata.yaml and .db3 or .mcap files, or one such file). They are read
by the package `rosbags` (`pip install 'epipole[ros]'`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from epipole._declared import checked
from epipole.cameras import Camera
from epipole.errors import ConfigError, EpipoleError, FileFormatError
from epipole.geometry import Rigid3
from epipole.inertial import ImuLog
from epipole.io._named_numbers import is_rotation
from epipole.io.bags import _images as images
from epipole.io.bags._files import BagMessage, OpenBag, is_bag, opened_bag
from epipole.io.bags._pairing import paired
from epipole.io.bags._topics import (
    BagSensor,
    BagTopic,
    base_name,
    choose_topics,
    is_rectified,
    listed_topics,
)
from epipole.io.images.deep_pixels import GreyScale
from epipole.io.images.pixels import MOST_SAMPLED
from epipole.io.sequences.imu_units import check_imu_units
from epipole.scene import StereoRig

__all__ = ["BagFrame", "BagSequence", "BagTopic", "bag_frames", "is_bag"]
__all__ += ["read_bag", "read_bag_imu", "read_bag_topics"]

PAIR_TOLERANCE_S = 0.005
"""Two cameras are triggered together: their stamps differ by the jitter of drivers."""
DEPTH_TOLERANCE_S = 0.02
"""Depth sensors run beside the colour camera (as the TUM set pairs them)."""
_FIRST_MESSAGES = 5


@dataclass(frozen=True, slots=True, eq=False)
class BagSequence:
    """What of a recording is followed."""

    path: Path
    sensor: BagSensor
    topics: tuple[str, ...]
    """Of the images; of left and right; of images and depth."""
    num_frames: int
    """Messages of the topic that has fewest."""
    size: tuple[int, int]
    """Width and height of the images."""
    camera: Camera | None
    """None where no CameraInfo tells it."""
    rig: StereoRig | None = None
    """Of a pair; None where no CameraInfo tells it."""
    depth_camera: Camera | None = None
    """Of the depth images, where a CameraInfo tells it."""
    depth_from_color: Rigid3 | None = None
    """None for depth that is registered to the images, or of a sensor whose place is not known."""
    warnings: tuple[str, ...] = ()
    scales: tuple[GreyScale | None, ...] = ()
    """How images of 16 bits become 8, by topic: the same way for all of a topic."""
    depth_values_per_m: float | None = None
    """Stored values for a metre by the encoding of the depth (REP 118); None without depth."""


@dataclass(frozen=True, slots=True, eq=False)
class BagFrame:
    """One instant; images are decoded when they are asked for, and raise FileFormatError where they are damaged."""

    timestamp_s: float
    grey: Callable[[], UInt8[np.ndarray, "h w"]]
    right_grey: Callable[[], UInt8[np.ndarray, "h w"]] | None = None
    depth: Callable[[], Float32[np.ndarray, "h2 w2"]] | None = None
    """Metres; 0 where not known."""


@dataclass(frozen=True, slots=True, eq=False)
class _Info:
    """A CameraInfo, as far as it is needed."""

    camera: Camera | None
    frame_id: str
    rectification: np.ndarray
    projection: np.ndarray


@checked
def read_bag_topics(path: str | Path) -> tuple[BagTopic, ...]:
    """The topics of a recording that have messages.

    Raises:
        FileFormatError: it cannot be read, or holds no message.
        MissingDependencyError: the package rosbags is not installed.
    """
    with opened_bag(Path(path)) as bag:
        return _topics(bag)


@checked
def read_bag(path: str | Path, sensor: str = "auto", topics: Sequence[str] = ()) -> BagSequence:
    """Which topics are followed, and their cameras.

    Args:
        path: the recording.
        sensor: mono, stereo or rgbd; auto takes depth, else a pair, where there is one.
        topics: names of the images' topic; of left and right; of images and depth. Empty: found by type and name.

    Raises:
        FileFormatError: the recording cannot be read, or a camera in it makes no sense.
        ConfigError: the topics asked for are not there, or several could be meant.
        MissingDependencyError: the package rosbags is not installed.
    """
    path = Path(path)
    with opened_bag(path) as bag:
        all_topics = _topics(bag)
        found, names = choose_topics(path, all_topics, sensor, topics)
        firsts = [_first(bag, name) for name in names]
        infos = [_info_of(bag, name, first, all_topics) for name, first in zip(names, firsts)]
        size = _size_of(path, names[0], firsts[0])
        scales = tuple(_scale(bag, name) for name in names[: 2 if found == "stereo" else 1])
    count = min(t.num_messages for t in all_topics if t.name in names)
    warnings = list(bag.warnings)
    for row, info in enumerate(infos[: 1 if found == "rgbd" else 2]):
        own = size if info is None or info.camera is None else (info.camera.width, info.camera.height)
        if own != size:
            infos[row] = None
            warnings.append(
                f"the CameraInfo of {names[row]} is of {own[0]} x {own[1]} pixels, its images are of "
                f"{size[0]} x {size[1]}: it is not used"
            )
    camera = None if infos[0] is None else infos[0].camera
    if found == "stereo":
        rig = None if camera is None or infos[1] is None else _rig(path, infos[0], infos[1])
        return BagSequence(
            path, found, names, count, size, camera, rig, warnings=tuple(warnings), scales=scales
        )
    if found == "mono":
        return BagSequence(path, found, names, count, size, camera, warnings=tuple(warnings), scales=scales)
    warnings += _unregistered(names[1], infos[0], infos[1])
    depth_camera = None if infos[1] is None else infos[1].camera
    per_m = images.values_per_metre(images.encoding_of(firsts[1]))
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
    """The frames of a recording, in the order in which they were recorded, by the stamps in their headers.

    Of two topics those belong together that are nearest, within 5 ms for a pair and 20 ms for depth; messages
    without a partner are passed over.

    Raises:
        FileFormatError: the recording is damaged from here on; the frames before it are sound.
    """
    with opened_bag(bag.path) as opened:
        rows = ((bag.topics.index(m.topic), *_stamped(opened, m)) for m in opened.messages(bag.topics))
        if bag.sensor == "mono":
            for _, time_s, content in rows:
                yield BagFrame(time_s, _grey(bag, 0, content))
            return
        tolerance = PAIR_TOLERANCE_S if bag.sensor == "stereo" else DEPTH_TOLERANCE_S
        for time_s, first, second in paired(rows, tolerance):
            if bag.sensor == "stereo":
                yield BagFrame(time_s, _grey(bag, 0, first), _grey(bag, 1, second))
            else:
                yield BagFrame(time_s, _grey(bag, 0, first), None, _depth(bag, second))


@checked
def read_bag_imu(path: str | Path, topic: str | None = None) -> ImuLog:
    """What an IMU measured (sensor_msgs/Imu), by the stamps in its headers.

    Args:
        path: the recording.
        topic: of the IMU; None where there is only one.

    Raises:
        FileFormatError: the recording cannot be read, a number is not finite, or measurements are in another unit.
        ConfigError: there is no such topic, or several and none is chosen.
        MissingDependencyError: the package rosbags is not installed.
    """
    path = Path(path)
    with opened_bag(path) as bag:
        imus = [t for t in _topics(bag) if t.kind == "imu" and topic in (None, t.name)]
        if len(imus) != 1:
            problem = "no topic of an IMU is found" if not imus else "there are several IMUs: choose a topic"
            raise ConfigError(f"{path}: {problem}, of {listed_topics(_topics(bag))}")
        rows = []
        for message in bag.messages([imus[0].name]):
            content = bag.content(message)
            rotation, acceleration = content.angular_velocity, content.linear_acceleration
            time_s = _stamp_s(content, message)
            rows.append(
                (time_s, rotation.x, rotation.y, rotation.z, acceleration.x, acceleration.y, acceleration.z)
            )
    values = np.array(rows, np.float64).reshape(-1, 7)
    if not np.isfinite(values).all():
        raise FileFormatError(path, f"{imus[0].name}: a measurement is not finite")
    values = values[np.unique(values[:, 0], return_index=True)[1]]  # by time; one of a doubled stamp
    check_imu_units(path, values[:, 0], values[:, 1:4], values[:, 4:])
    return ImuLog(values[:, 0].copy(), values[:, 1:4].copy(), values[:, 4:].copy())


def _topics(bag: OpenBag) -> tuple[BagTopic, ...]:
    kinds = {images.CAMERA_INFO: "camera", images.IMU: "imu"}
    found = []
    for name, kind in bag.kinds.items():
        if not bag.counts[name]:
            continue
        what: Any = kinds.get(kind, "other")
        if kind in (images.IMAGE, images.COMPRESSED):
            what = "depth" if images.is_depth(name, images.encoding_of(_first(bag, name))) else "image"
        found.append(BagTopic(name, what, kind, bag.counts[name]))
    return tuple(sorted(found, key=lambda t: t.name))


def _first(bag: OpenBag, topic: str) -> Any:
    """The first message that can be read.

    Raises:
        FileFormatError: none of the first can be read.
    """
    problem = FileFormatError(bag.path, f"{topic} holds no message")
    for message in islice(bag.messages([topic]), _FIRST_MESSAGES):
        try:
            return bag.content(message)
        except FileFormatError as error:
            problem = error
    raise problem


def _scale(bag: OpenBag, topic: str) -> GreyScale | None:
    """From the first images of a topic that can be read."""
    contents: list[Any] = []
    for message in islice(bag.messages([topic]), MOST_SAMPLED):
        with suppress(FileFormatError):
            contents.append(bag.content(message))
    with suppress(FileFormatError):  # it is raised where the image is read
        return images.grey_scale(bag.path, topic, contents)
    return None


def _size_of(path: Path, topic: str, message: Any) -> tuple[int, int]:
    height, width = images.grey_of(path, topic, message).shape
    return width, height


def _info_of(bag: OpenBag, topic: str, first: Any, topics: Sequence[BagTopic]) -> _Info | None:
    """The CameraInfo beside a topic of images; else the only one of the same frame."""
    names = [t.name for t in topics if t.kind == "camera"]
    beside = f"{base_name(topic).rpartition('/')[0]}/camera_info"
    if beside in names:
        return _info(bag.path, _first(bag, beside), is_rectified(topic))
    infos = [_first(bag, name) for name in names]
    own = [message for message in infos if message.header.frame_id == first.header.frame_id]
    return _info(bag.path, own[0], is_rectified(topic)) if len(own) == 1 else None


def _info(path: Path, message: Any, is_flat: bool) -> _Info:
    camera = images.camera_of(path, message, is_rectified=is_flat)
    rotation = np.eye(3) if is_flat else images.field(message, "r").reshape(3, 3)
    projection = images.field(message, "p").reshape(3, 4)
    return _Info(camera, str(message.header.frame_id), rotation, projection)


def _unregistered(depth_topic: str, color: _Info | None, depth: _Info | None) -> list[str]:
    """A warning about depth of another frame than the images'."""
    if any(word in depth_topic for word in ("aligned", "registered")):
        return []
    if color is None or depth is None or color.frame_id == depth.frame_id:
        return []
    return [
        f"the depth of {depth_topic} is not registered to the images (its frame is {depth.frame_id}), and is "
        "taken as if both were at one place"
    ]


def _rig(path: Path, left: _Info | None, right: _Info | None) -> StereoRig | None:
    """As ROS has it: x_rectified = R x, and P of the right camera has -f B in its corner; None without a baseline."""
    assert left is not None and right is not None
    if left.camera is None or right.camera is None:
        return None
    projections = [left.projection, right.projection]
    if not all(p[0, 0] > 0 and np.isfinite(p).all() for p in projections):
        return None
    if not (is_rotation(left.rectification) and is_rotation(right.rectification)):
        raise FileFormatError(path, "R in the CameraInfo of the pair holds no rotation")
    offset = right.projection[:, 3] / right.projection[0, 0] - left.projection[:, 3] / left.projection[0, 0]
    if not np.abs(offset).max() > 0:
        return None
    right_from_left = Rigid3(right.rectification.T @ left.rectification, right.rectification.T @ offset)
    try:
        return StereoRig(left.camera, right.camera, right_from_left)
    except EpipoleError as error:
        raise FileFormatError(path, f"the CameraInfo of the pair: {error}") from error


def _stamped(bag: OpenBag, message: BagMessage) -> tuple[float, Any]:
    """Seconds and what the message says; an error instead of a damaged one, at the time of its recording."""
    try:
        content = bag.content(message)
        return _stamp_s(content, message), content
    except FileFormatError as error:
        return message.recorded_ns * 1e-9, error


def _stamp_s(content: Any, message: BagMessage) -> float:
    """Of the header; of the recording, where drivers leave that at zero."""
    stamp = content.header.stamp
    ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    return (ns or message.recorded_ns) * 1e-9


def _grey(bag: BagSequence, row: int, content: Any) -> Callable[[], np.ndarray]:
    def read() -> np.ndarray:
        if isinstance(content, FileFormatError):
            raise content
        scale = bag.scales[row] if row < len(bag.scales) else None
        return images.grey_of(bag.path, bag.topics[row], content, scale)

    return read


def _depth(bag: BagSequence, content: Any) -> Callable[[], np.ndarray]:
    def read() -> np.ndarray:
        if isinstance(content, FileFormatError):
            raise content
        return images.depth_of(bag.path, bag.topics[1], content)

    return read
