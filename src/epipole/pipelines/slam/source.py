"""Frames from files: read, undistorted or rectified, and the camera that they are of."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.disparity_search.rectification import Rectification, rectify
from epipole.errors import ConfigError, EpipoleError
from epipole.geometry import Rigid3
from epipole.image.undistort import undistort_image, undistorted_camera
from epipole.io.depth_maps import read_png16
from epipole.io.photographs import read_grey
from epipole.io.sequences import FrameFiles, ImageSequence
from epipole.io.video import opened_video
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera

Sensor = Literal["auto", "mono", "stereo", "rgbd"]
FAR_MM = 65535
"""What depth cameras write where they see nothing, besides zero."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameSource:
    """Frames to be followed, one after the other."""

    camera: SlamCamera
    num_frames: int
    frames: Callable[[], Iterator[Frame | EpipoleError]]
    """In order of time; an error where the files of one cannot be read, or do not fit each other."""
    names: tuple[str, ...]
    """Of the frames' pictures."""
    body_from_camera: Rigid3
    """From the camera that is followed (rectified, where it is one of two) to the one that took the pictures."""


def open_sequence(sequence: ImageSequence, sensor: Sensor, camera: Camera | None) -> FrameSource:
    """The frames of a folder.

    Args:
        sequence: the folder's files.
        sensor: what to use of them; auto takes depth, else the second camera, where there is one.
        camera: given intrinsics, instead of the folder's.

    Raises:
        ConfigError: the intrinsics are not known, or the sensor asked for is not there.
    """
    kind = _kind_of(sequence, sensor)
    lens = sequence.camera if camera is None else camera
    if lens is None:
        raise ConfigError(
            f"nothing tells the camera of these {sequence.kind.value}: give camera_params, or a calibration"
        )
    names = tuple(frame.picture.name for frame in sequence.frames)
    if kind == "stereo":
        return _stereo(sequence, names, camera)
    if kind == "mono":
        return FrameSource(
            SlamCamera(lens), len(sequence), lambda: _read(sequence, _mono_frame), names, Rigid3.identity()
        )
    return _rgbd(sequence, names, lens)


def open_video_frames(path: Path, camera: Camera | None) -> FrameSource:
    """The frames of a video.

    Raises:
        ConfigError: the intrinsics are not given.
        FileFormatError: it is no video.
    """
    if camera is None:
        raise ConfigError("nothing tells the camera of a video: give camera_params, or a calibration")
    capture = opened_video(path)
    count = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 1)
    rate = capture.get(cv2.CAP_PROP_FPS)
    capture.release()
    rate = rate if 0 < rate < 1e4 else 30.0
    names = tuple(f"frame_{n:06d}.jpg" for n in range(count))

    def frames() -> Iterator[Frame | EpipoleError]:
        video, number = opened_video(path), 0
        while True:
            is_read, picture = video.read()
            if not is_read:
                return
            yield Frame(number / rate, cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
            number += 1

    return FrameSource(SlamCamera(camera), count, frames, names, Rigid3.identity())


def _kind_of(sequence: ImageSequence, sensor: Sensor) -> str:
    has_right = sequence.rig is not None and sequence.frames[0].right is not None
    if sensor == "stereo" and not has_right:
        raise ConfigError("there is no second camera with a calibration in these frames")
    if sensor == "rgbd" and sequence.depth is None:
        raise ConfigError("there are no depth pictures in these frames")
    if sensor != "auto":
        return sensor
    return "rgbd" if sequence.depth is not None else "stereo" if has_right else "mono"


def _read(sequence: ImageSequence, made: Callable[[FrameFiles], Frame]) -> Iterator[Frame | EpipoleError]:
    for files in sequence.frames:
        try:
            yield made(files)
        except EpipoleError as error:
            yield error


def _mono_frame(files: FrameFiles) -> Frame:
    return Frame(files.timestamp_s, read_grey(files.picture))


def _stereo(sequence: ImageSequence, names: tuple[str, ...], camera: Camera | None) -> FrameSource:
    if camera is not None:
        raise ConfigError("the folder's calibration of both cameras is used: give no other")
    assert sequence.rig is not None
    found: Rectification | None = None
    rig = sequence.rig
    is_flat = (
        rig.left.model == rig.right.model == CameraModel.PINHOLE
        and np.array_equal(rig.left.params, rig.right.params)
        and np.abs(rig.right_from_left.rotation - np.eye(3)).max() < 1e-9
        and np.abs(rig.right_from_left.translation[1:]).max() < 1e-9 * rig.baseline
    )
    lens, turned = rig.left, Rigid3.identity()
    if not is_flat:
        found = rectify(rig)
        flat = found.rig
        lens = Camera(
            CameraModel.PINHOLE, *found.size, np.array([flat.focal_px, flat.focal_px, flat.cx, flat.cy])
        )
        turned = Rigid3(found.rectified_from_left.T.copy(), np.zeros(3))

    def frame(files: FrameFiles) -> Frame:
        assert files.right is not None
        left, right = read_grey(files.picture), read_grey(files.right)
        if found is not None:
            left, right = found.apply(left, right)
        return Frame(files.timestamp_s, left, right)

    return FrameSource(
        SlamCamera(lens, rig.baseline), len(sequence), lambda: _read(sequence, frame), names, turned
    )


def _rgbd(sequence: ImageSequence, names: tuple[str, ...], lens: Camera) -> FrameSource:
    told = sequence.depth
    assert told is not None
    flat = lens if lens.model == CameraModel.PINHOLE else undistorted_camera(lens)
    # A depth picture that was registered to the colour picture has its distortion, too.
    sensor = DepthCamera(told.camera or lens, told.depth_from_color or Rigid3.identity())

    def frame(files: FrameFiles) -> Frame:
        assert files.depth is not None
        depth = np.nan_to_num(read_png16(files.depth, 1.0), nan=0.0)
        depth = np.where(depth == FAR_MM, 0.0, depth / told.unit).astype(np.float32)
        grey = read_grey(files.picture)
        return Frame(
            files.timestamp_s, grey if flat is lens else undistort_image(grey, lens, flat), None, depth
        )

    return FrameSource(
        SlamCamera(flat, None, sensor),
        len(sequence),
        lambda: _read(sequence, frame),
        names,
        Rigid3.identity(),
    )
