"""Frames of a rig of cameras from a ROS bag."""

from __future__ import annotations

from collections.abc import Generator
from functools import partial
from pathlib import Path

from epipole.geometry import Rigid3
from epipole.io.bags.rig_recording import BagRigFrame, bag_rig_frames, read_bag_rig
from epipole.io.calibration.camera_topics import camera_topics
from epipole.pipelines.slam.config import CameraOptions, JobOptions
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.sources.folder import FrameSource, QueuedFrame
from epipole.pipelines.slam.sources.rig_folder import check_size, rig_of
from epipole.pipelines.slam.sources.streams import Counted
from epipole.scene import CameraRig


def open_rig_bag(path: Path, job: JobOptions, given: CameraOptions) -> FrameSource:
    """Open the frames of a ROS bag with an image topic for each camera of a calibration file.

    Raises:
        ConfigError: there is no calibration of several cameras, the topics are missing or ambiguous, or the images do not have the
            cameras' sizes.
        FileFormatError: the calibration or the bag cannot be read.
        MissingDependencyError: the package rosbags is not installed.
    """
    rig = rig_of(given)
    assert given.calibration is not None
    bag = read_bag_rig(path, len(rig.cameras), job.topic_names, camera_topics(given.calibration))
    for topic, size, camera in zip(bag.topics, bag.sizes, rig.cameras):
        check_size(topic, size, camera)
    counted = Counted(bag.num_frames, "{} of {} frames of the bag have a matching time stamp in all topics")
    names: dict[str, tuple[str, ...]] = {}

    def frames() -> Generator[QueuedFrame, None, None]:
        for frame in bag_rig_frames(bag):
            row = tuple(f"cam{k}/frame_{counted.num:06d}.jpg" for k in range(len(rig.cameras)))
            names[row[0]] = row  # the number of messages in a bag's index may be wrong
            yield QueuedFrame(counted.num, frame.timestamp_s, row[0], partial(_frame, frame, rig))
            counted.num += 1
        counted.is_over = True

    return FrameSource(
        SlamCamera.of_cameras(rig),
        bag.num_frames,
        frames,
        Rigid3.identity(),
        lambda: [*bag.warnings, *counted.notes()],
        rig_names=names,
        about={"layout": "ROS", "sensor": "rig", "camera_source": "given", "topics": list(bag.topics)},
    )


def _frame(frame: BagRigFrame, rig: CameraRig) -> Frame:
    return Frame.from_rig(frame.timestamp_s, [read() for read in frame.grays], rig)
