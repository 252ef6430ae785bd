"""Frames of a rig of cameras from a folder."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from epipole.cameras import Camera
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io.calibration.files import read_calibration
from epipole.io.images.photographs import (
    PhotographHeader,
    common_range,
    mask_of,
    read_gray,
    read_header,
    read_mask,
)
from epipole.io.sequences.rig_folders import RigFiles, RigSequence, read_rig_sequence
from epipole.pipelines.slam.config import CameraOptions, JobOptions
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.sources.folder import FrameSource, QueuedFrame
from epipole.scene import CameraRig

MOST_DAMAGED = 20
"""Images at the beginning among which one must be readable to check the size before the run."""


def open_rig_folder(folder: Path, job: JobOptions, given: CameraOptions) -> FrameSource:
    """Open the frames of the folders cam0, cam1, ..., with the cameras of a calibration file.

    Raises:
        ConfigError: there is no calibration, or one camera's parameters besides; it has one camera only; or the images do not have
            the cameras' sizes.
        FileFormatError: the calibration or the folder cannot be read.
    """
    rig = rig_of(given)
    sequence = read_rig_sequence(folder, len(rig.cameras), job.fps)
    _check_sizes(rig, sequence)
    names = [image_names(sequence, files) for files in sequence.frames]
    if job.masks is not None and not any(mask_of(job.masks, name) for row in names for name in row):
        raise ConfigError(
            f"no image has a mask in {job.masks}: expected cam0/NAME.png for the image cam0/NAME"
        )

    def frames() -> Generator[QueuedFrame, None, None]:
        # All frames of a camera get the same mapping to 8 bits, since tracking compares their gray values.
        limits = [common_range(list(images)) for images in zip(*(files.images for files in sequence.frames))]
        for number, files in enumerate(sequence.frames):

            def read(files: RigFiles = files, own: Sequence[str] = names[number]) -> Frame:
                images = [read_gray(image, limits=limit) for image, limit in zip(files.images, limits)]
                masks = None if job.masks is None else [_ignored(job.masks, name) for name in own]
                return Frame.from_rig(files.timestamp_s, images, rig, masks)

            yield QueuedFrame(number, files.timestamp_s, names[number][0], partial(read))

    camera = SlamCamera.of_cameras(rig)
    about = {"layout": "a folder for each camera", "sensor": "rig", "camera_source": "given"}
    return FrameSource(
        camera,
        len(sequence.frames),
        frames,
        Rigid3.identity(),
        lambda: sequence.warnings,
        rig_names={row[0]: row for row in names},
        about=about,
    )


def rig_of(given: CameraOptions) -> CameraRig:
    """The cameras of a calibration file.

    Raises:
        ConfigError: there is no calibration, or one camera's parameters besides; or it has one camera only.
        FileFormatError: the calibration cannot be read.
    """
    if given.calibration is None:
        raise ConfigError(
            "sensor rig needs the cameras' intrinsics and poses: pass --calibration FILE, such as Kalibr's"
        )
    if given.camera_params or given.camera_model:
        raise ConfigError(
            "sensor rig takes all intrinsics from the calibration: omit camera_params and camera_model"
        )
    found = read_calibration(given.calibration)
    if len(found.cameras) < 2:
        raise ConfigError(f"{given.calibration} has one camera, but a rig has two or more")
    return CameraRig(found.cameras, found.cam_from_rig)


def image_names(sequence: RigSequence, files: RigFiles) -> tuple[str, ...]:
    """Names of the images of one instant, relative to the folder."""
    return tuple(image.relative_to(sequence.folder).as_posix() for image in files.images)


def _ignored(masks: Path, name: str) -> np.ndarray | None:
    used = read_mask(masks, name)
    return None if used is None else ~used


def _first_header(images: Sequence[Path]) -> PhotographHeader | None:
    for image in images:
        with suppress(FileFormatError):
            return read_header(image)
    return None


def _check_sizes(rig: CameraRig, sequence: RigSequence) -> None:
    """Check the first readable image of each camera; damaged ones are reported when their frames are read."""
    for k, camera in enumerate(rig.cameras):
        header = _first_header([files.images[k] for files in sequence.frames[:MOST_DAMAGED]])
        if header is not None:
            check_size(f"cam{k}", (header.width, header.height), camera)


def check_size(name: str, size: tuple[int, int], camera: Camera) -> None:
    """Check that a camera's images have the size of its calibration.

    Raises:
        ConfigError: they do not.
    """
    if size != (camera.width, camera.height):
        raise ConfigError(
            f"the images of {name} are {size[0]} x {size[1]}, but the calibration is for {camera.width} x {camera.height}"
        )
