"""Frames of videos and ROS bags."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from epipole.cameras import Camera
from epipole.cameras.image_fit import ImageShape
from epipole.errors import ConfigError, FileFormatError
from epipole.io.bags.recording import BagFrame, BagSequence, bag_frames, read_bag
from epipole.io.images.video import announced_frames, frame_orientation, opened_video
from epipole.pipelines.slam.config import CameraOptions, JobOptions
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.sources.folder import (
    FrameSource,
    Preparation,
    QueuedFrame,
    of_depth,
    of_one_camera,
    of_pair,
)

_USUAL_HZ = 30.0
_GIVEN = "given"
_WHOLE = 0.98
"""Fraction of the announced frames from which on a video or bag counts as complete: containers round the number."""


def open_video_frames(
    path: Path, given: CameraOptions, found: Camera | None = None, *, is_pair: bool = False
) -> FrameSource:
    """Open the frames of a video.

    Args:
        path: the file.
        given: given camera options.
        found: the camera, if it was estimated from the images.
        is_pair: whether each frame has the left and the right image side by side.

    Raises:
        ConfigError: the intrinsics are unknown, or the calibration is not that of the halves.
        FileFormatError: the file is not a video, or none of its frames can be read.
    """
    capture = opened_video(path)
    is_read, first = capture.read()
    count, is_counted = announced_frames(path, capture)
    rate = capture.get(cv2.CAP_PROP_FPS)
    capture.release()
    if not is_read:
        raise FileFormatError(path, "no frame of the video can be decoded")
    shape = ImageShape(first.shape[1], first.shape[0], frame_orientation(path))
    made, notes = (
        _of_both_views(path, first, given)
        if is_pair
        else _of_video(given, (found, []) if found else None, shape)
    )
    rate = rate if 0 < rate < 1e4 else _USUAL_HZ
    end = "the video ends after {} of {} announced frames"
    counted = Counted(count if is_counted else 0, end)

    def frames() -> Generator[QueuedFrame, None, None]:
        video, seconds = opened_video(path), -1.0 / rate
        try:
            while True:
                is_read, image = video.read()
                if not is_read:
                    counted.is_over = True
                    return
                position_s = video.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
                seconds = position_s if position_s > seconds and counted.num else seconds + 1.0 / rate
                images = np.array_split(image, 2, axis=1) if is_pair else [image]
                yield _queued(counted.num, seconds, partial(_of_color, made, seconds, images))
                counted.num += 1
        finally:
            video.release()

    def all_notes() -> list[str]:
        return [*notes, *counted.notes(), *made.notes()]

    about = {"layout": "video", "sensor": "stereo" if is_pair else "mono", "camera_source": _GIVEN}
    return FrameSource(made.camera, max(count, 1), frames, made.body_from_camera, all_notes, about=about)


def _of_video(
    given: CameraOptions, found: tuple[Camera, list[str]] | None, shape: ImageShape
) -> tuple[Preparation, list[str]]:
    intrinsics = found or given.fitted_camera(shape)
    if intrinsics is None:
        raise ConfigError(
            "unknown camera intrinsics of the video: pass camera_params (fx,fy,cx,cy) or a calibration"
        )
    return of_one_camera(intrinsics[0]), intrinsics[1]


def _of_both_views(path: Path, image: np.ndarray, given: CameraOptions) -> tuple[Preparation, list[str]]:
    height, width = image.shape[:2]
    if width % 2:
        raise ConfigError(
            f"{path} is {width} pixels wide: it does not have two images of one size side by side"
        )
    rig = given.rig((width // 2, height))
    if rig is None:
        raise ConfigError(
            "a video with two images side by side needs the geometry of the cameras: pass a calibration of both"
        )
    return of_pair(rig), []


def open_bag_frames(path: Path, job: JobOptions, given: CameraOptions) -> FrameSource:
    """Open the frames of a ROS bag.

    Raises:
        ConfigError: the topics are missing or ambiguous, or the intrinsics are unknown.
        FileFormatError: the bag cannot be read.
        MissingDependencyError: the package rosbags is not installed.
    """
    bag = read_bag(path, job.sensor, job.topic_names)
    made, factor = _preparation_of(bag, given), _depth_factor(bag, given)
    what = "could be read" if bag.sensor == "mono" else "have a matching time stamp in the other topic"
    counted = Counted(bag.num_frames, f"{{}} of {{}} frames of the bag {what}")

    def frames() -> Generator[QueuedFrame, None, None]:
        for frame in bag_frames(bag):
            yield _queued(counted.num, frame.timestamp_s, partial(_of_bag, made, factor, frame))
            counted.num += 1
        counted.is_over = True

    def notes() -> list[str]:
        return [*bag.warnings, *counted.notes(), *made.notes()]

    about = _about_bag(bag, given)
    return FrameSource(made.camera, bag.num_frames, frames, made.body_from_camera, notes, about=about)


class Counted:
    """Counts the frames and compares them with the announced number."""

    def __init__(self, announced: int, words: str) -> None:
        self.announced, self.words, self.num, self.is_over = announced, words, 0, False

    def notes(self) -> list[str]:
        """A warning if a source that was read to its end has fewer frames than announced."""
        if not self.is_over or self.num >= _WHOLE * self.announced - 1:
            return []
        return [self.words.format(self.num, self.announced)]


def _preparation_of(bag: BagSequence, given: CameraOptions) -> Preparation:
    if bag.sensor == "stereo":
        rig = given.rig(bag.size) or bag.rig
        if rig is None:
            raise ConfigError(
                f"{bag.path} has no CameraInfo with both cameras and the baseline: pass a calibration of both"
            )
        return of_pair(rig)
    intrinsics = given.camera(bag.size) or bag.camera
    if intrinsics is None:
        raise ConfigError(
            f"{bag.path} has no CameraInfo with the intrinsics: pass camera_params or a calibration"
        )
    if bag.sensor == "mono":
        return of_one_camera(intrinsics)
    return of_depth(intrinsics, bag.depth_camera, bag.depth_from_color)


def _queued(number: int, seconds: float, read: Callable[[], Frame]) -> QueuedFrame:
    return QueuedFrame(number, seconds, f"frame_{number:06d}.jpg", read)


def _of_bag(made: Preparation, depth_factor: float, frame: BagFrame) -> Frame:
    if frame.depth is not None:
        return made.frame(frame.timestamp_s, frame.gray(), np.float32(depth_factor) * frame.depth())
    return made.frame(
        frame.timestamp_s, frame.gray(), *([] if frame.right_gray is None else [frame.right_gray()])
    )


def _depth_factor(bag: BagSequence, given: CameraOptions) -> float:
    """Factor that corrects depth decoded with the encoding's unit to the given depth scale.

    Raises:
        ConfigError: a depth scale is given, but no depth is used.
    """
    if given.depth_scale is None:
        return 1.0
    if bag.depth_values_per_m is None:
        raise ConfigError(f"depth_scale is given, but the depth of {bag.path} is not used: check sensor")
    return bag.depth_values_per_m / given.depth_scale


def _about_bag(bag: BagSequence, given: CameraOptions) -> dict[str, Any]:
    is_given = given.calibration is not None or given.camera_params is not None
    out: dict[str, Any] = {"layout": "ROS", "sensor": bag.sensor}
    out["camera_source"] = _GIVEN if is_given else "CameraInfo"
    if bag.depth_values_per_m is not None:
        known = given.depth_scale
        out["depth_scale"] = bag.depth_values_per_m if known is None else known
        out["depth_scale_source"] = "the encoding (REP 118)" if known is None else _GIVEN
    return out


def _of_color(made: Preparation, seconds: float, images: Sequence[np.ndarray]) -> Frame:
    grays = (image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images)
    return made.frame(seconds, *map(np.ascontiguousarray, grays))
