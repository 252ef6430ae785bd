"""Frame sources: cameras and frames of any source, and reading them from folders."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import UInt8

from epipole.cameras import Camera, CameraModel
from epipole.cameras.image_fit import ImagePixels, ImageShape, fit_notes
from epipole.errors import ConfigError, EpipoleError, FileFormatError, ShapeError
from epipole.geometry import Rigid3
from epipole.image.undistort import undistorted_camera, undistortion_map_px
from epipole.io.images.depth_maps import read_png16
from epipole.io.images.photographs import (
    GrayRange,
    common_range,
    mask_of,
    read_gray,
    read_header,
    read_mask,
    read_rgb,
)
from epipole.io.sequences.sequence import CALIBRATION_NOT_USED, FrameFiles, ImageSequence
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera, rectification_of, require_size
from epipole.pipelines.slam.sources.depth_range import DepthRange
from epipole.scene import StereoRig

ReadImage = Callable[[Path], UInt8[np.ndarray, "h w"]]

LONGEST_BASELINE_M = 5.0
"""Longest baseline of a pair of cameras that is not questioned."""
FAR_MM = 65535
"""Value for unknown depth, besides zero."""


@dataclass(frozen=True, slots=True, eq=False)
class QueuedFrame:
    """A frame whose images are read on demand."""

    number: int
    """Number in the source, from 0."""
    timestamp_s: float
    name: str
    """Image name."""
    read: Callable[[], Frame]
    """Reads the images; raises an EpipoleError if files are damaged or do not fit each other."""
    read_rgb: Callable[[], np.ndarray] | None = None
    """Reads the colors at the pixels of the frame's image; None if the source gives gray values only."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameSource:
    """A sequence of frames and its camera."""

    camera: SlamCamera
    num_frames: int
    """Announced number of frames; 0 for a live camera."""
    frames: Callable[[], Generator[QueuedFrame, None, None]]
    """Yields the frames in order; raises an EpipoleError if the rest of the source is damaged."""
    body_from_camera: Rigid3
    """From the tracked camera (rectified, if it is one of a pair) to the camera that took the images."""
    notes: Callable[[], Sequence[str]] = tuple
    """Warnings about the frames read so far."""
    is_live: bool = False
    """Whether this is a live camera, whose frames cannot be read again."""
    rig_names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Of a rig: the names of all images of an instant, by the frame's name, which is that of the first camera's image."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """For the summary: layout, and sources of the intrinsics and of the depth unit."""


@dataclass(frozen=True, slots=True, eq=False)
class Preparation:
    """Converts images to frames, which are free of distortion if there is depth or a second camera."""

    camera: SlamCamera
    body_from_camera: Rigid3
    frame: Callable[..., Frame]
    """Makes a frame of seconds, the gray image, and the right gray image or depth in meters."""
    notes: Callable[[], Sequence[str]] = tuple
    flat: Callable[[np.ndarray], np.ndarray] = np.asarray
    """Undistorts or rectifies a gray or RGB image of the (left) camera in the same way."""


def of_one_camera(intrinsics: Camera) -> Preparation:
    """Use the images of one camera unchanged."""
    return Preparation(SlamCamera(intrinsics), Rigid3.identity(), Frame)


def of_pair(rig: StereoRig) -> Preparation:
    """Rectify the images of two cameras, unless they are rectified already."""
    camera, found = SlamCamera.of_rig(rig), rectification_of(rig)
    if found is None:
        return Preparation(camera, Rigid3.identity(), Frame, lambda: _notes_on_baseline(rig))
    assert camera.left_from_camera is not None
    return Preparation(
        camera,
        camera.left_from_camera,
        lambda seconds, left, right: Frame.from_pair(seconds, left, right, rig),
        notes=lambda: _notes_on_baseline(rig),
        flat=lambda image: found.apply(image, image)[0],
    )


def _notes_on_baseline(rig: StereoRig) -> list[str]:
    """A warning if the baseline is that of a calibration in millimeters or centimeters."""
    if rig.baseline <= LONGEST_BASELINE_M:
        return []
    return [
        f"the baseline of the pair is {rig.baseline:g} m: if the calibration is in another unit, all lengths are wrong by that factor"
    ]


def of_depth(intrinsics: Camera, sensor: Camera | None, depth_from_color: Rigid3 | None) -> Preparation:
    """Undistort images with depth.

    Args:
        intrinsics: intrinsics of the images.
        sensor: intrinsics of the depth images; None if they are registered to the images, with the same distortion.
        depth_from_color: pose of the color camera in the depth camera; None for the identity.
    """
    flat = intrinsics if intrinsics.model == CameraModel.PINHOLE else undistorted_camera(intrinsics)
    table = None if flat is intrinsics else undistortion_map_px(intrinsics, flat)
    depth_camera = DepthCamera(sensor or intrinsics, depth_from_color or Rigid3.identity())
    ranges = DepthRange()

    def flat_image(image: np.ndarray) -> np.ndarray:
        if table is None:
            return image
        require_size("image", image, intrinsics)
        return cv2.remap(image, table[..., 0], table[..., 1], cv2.INTER_LINEAR)

    def frame(seconds: float, gray: np.ndarray, depth: np.ndarray) -> Frame:
        gray = flat_image(gray)
        ranges.add(depth)
        return Frame(seconds, gray, None, depth)

    camera = SlamCamera(flat, None, depth_camera)
    return Preparation(camera, Rigid3.identity(), frame, ranges.notes, flat_image)


def open_sequence(
    sequence: ImageSequence,
    sensor: Literal["auto", "mono", "stereo", "rgbd"],
    camera: Camera | None,
    masks: Path | None = None,
) -> FrameSource:
    """Open the frames of a folder.

    Args:
        sequence: the folder's files.
        sensor: what to use of them; auto uses depth, else the second camera, if there is one.
        camera: intrinsics that replace the folder's.
        masks: folder of masks, MASKS/NAME.png, black where an image is ignored; None for no masks.

    Raises:
        ConfigError: the intrinsics are unknown, the requested sensor is missing, or no image has a mask.
    """
    kind = _kind_of(sequence, sensor)
    if masks is not None and not any(mask_of(masks, files.image.name) for files in sequence.frames):
        raise ConfigError(f"no image has a mask in {masks}: expected NAME.png for the image NAME")
    intrinsics = sequence.camera if camera is None else camera
    if intrinsics is None:
        why = sequence.camera_problem or next((w for w in sequence.warnings if CALIBRATION_NOT_USED in w), "")
        why = f"{why}. " if why else ""
        raise ConfigError(
            f"{why}Unknown camera intrinsics for {sequence.kind.value}: pass --camera-params fx,fy,cx,cy or --calibration FILE"
        )
    notes = [] if camera is not None else _fit_to_folder(sequence, intrinsics)
    if kind == "stereo":
        if camera is not None:
            raise ConfigError("stereo uses the folder's calibration: pass no other")
        assert sequence.rig is not None
        made, read = of_pair(sequence.rig), _read_pair
    elif kind == "mono":
        made, read = of_one_camera(intrinsics), _read_one
    else:
        assert sequence.depth is not None
        made = of_depth(intrinsics, sequence.depth.camera, sequence.depth.depth_from_color)
        read = partial(_read_with_depth, unit=sequence.depth.unit)

    read = partial(read, made)

    def frames() -> Generator[QueuedFrame, None, None]:
        # All frames get the same mapping to 8 bits, since tracking compares their gray values.
        limits = common_range([files.image for files in sequence.frames])
        rotation_tracker = _ImageRotation(sequence.frames[0], limits)
        for number, files in enumerate(sequence.frames):
            plain = partial(read, rotation_tracker, files)
            masked = plain if masks is None else partial(_with_mask, plain, made, masks, files.image)
            colors = partial(_read_colors, made, rotation_tracker, files)
            yield QueuedFrame(number, files.timestamp_s, files.image.name, masked, colors)

    return FrameSource(
        made.camera,
        len(sequence),
        frames,
        made.body_from_camera,
        lambda: [*notes, *sequence.warnings, *made.notes()],
        about=_about(sequence, kind, is_camera_given=camera is not None),
    )


def _about(sequence: ImageSequence, kind: str, *, is_camera_given: bool) -> dict[str, Any]:
    """Assumptions about the folder, for the summary."""
    out: dict[str, Any] = {"layout": sequence.kind.value, "sensor": kind}
    out["camera_source"] = "given" if is_camera_given else sequence.camera_source
    if kind == "rgbd" and sequence.depth is not None:
        out["depth_scale"], out["depth_scale_source"] = sequence.depth.unit, sequence.depth.unit_source
        is_registered = sequence.depth.camera is None and sequence.depth.depth_from_color is None
        out["is_depth_registered"] = is_registered
    return out


def _fit_to_folder(sequence: ImageSequence, intrinsics: Camera) -> list[str]:
    """Check the folder's intrinsics against sample images, some of which may be damaged; returns warnings.

    Raises:
        ConfigError: the camera's size differs from that of all samples.
    """
    shapes = []
    for row in sorted({0, len(sequence) // 2, len(sequence) - 1}):
        try:
            header = read_header(sequence.frames[row].image)
        except FileFormatError:
            continue
        shapes.append(ImageShape(header.width, header.height, header.orientation))
    sizes = {(shape.width, shape.height) for shape in shapes}
    if sizes and (intrinsics.width, intrinsics.height) not in sizes:
        size = " x ".join(map(str, sizes.pop()))
        raise ConfigError(
            f"the camera ({sequence.camera_source}) is for images of {intrinsics.width} x {intrinsics.height} pixels, but these are {size}: pass"
            " --camera-params fx,fy,cx,cy or --calibration FILE"
        )
    return fit_notes(intrinsics, shapes[:1], ImagePixels.UPRIGHT, f"the camera ({sequence.camera_source})")


def _with_mask(plain: Callable[[], Frame], made: Preparation, masks: Path, image: Path) -> Frame:
    frame = plain()
    used_mask = read_mask(masks, image.name)
    if used_mask is None:
        return frame
    ignored_mask = made.flat(np.where(used_mask, 0, 255).astype(np.uint8)) > 0
    if ignored_mask.shape != frame.gray.shape:
        raise ShapeError(f"the mask of {image.name} does not have the image's size")
    return replace(frame, ignored_mask=ignored_mask)


def _kind_of(sequence: ImageSequence, sensor: str) -> str:
    has_right = sequence.rig is not None and sequence.frames[0].right is not None
    if sensor == "stereo" and not has_right:
        why = f": {sequence.camera_problem}" if sequence.camera_problem else ""
        raise ConfigError(f"these frames have no calibrated second camera{why}")
    if sensor == "rgbd" and sequence.depth is None:
        why = "".join(
            f"; {words}" for words in sequence.warnings if words.startswith("the depth images are not used")
        )
        raise ConfigError(f"these frames have no depth images{why}")
    if sensor != "auto":
        return sensor
    return "rgbd" if sequence.depth is not None else "stereo" if has_right else "mono"


class _ImageRotation:
    """Reads all images of a camera with the EXIF orientation of its first one, since its mounting does not change."""

    def __init__(self, first: FrameFiles, limits: GrayRange | None) -> None:
        self._first = first
        self._limits = limits

    @cached_property
    def _left(self) -> int | None:
        return _orientation_of(self._first.image)

    @cached_property
    def _right(self) -> int | None:
        assert self._first.right is not None
        return _orientation_of(self._first.right)

    def left(self, files: FrameFiles) -> np.ndarray:
        """The gray image of the (left) camera."""
        return read_gray(files.image, limits=self._limits, orientation=self._left)

    def left_rgb(self, files: FrameFiles) -> np.ndarray:
        """The same image as RGB."""
        return read_rgb(files.image, limits=self._limits, orientation=self._left)

    def right(self, files: FrameFiles) -> np.ndarray:
        """The gray image of the right camera."""
        assert files.right is not None
        return read_gray(files.right, limits=self._limits, orientation=self._right)


def _orientation_of(path: Path) -> int | None:
    """EXIF orientation; None if it cannot be read, and each image then uses its own."""
    try:
        return read_header(path).orientation
    except EpipoleError:
        return None


def _read_one(made: Preparation, rotation_tracker: _ImageRotation, files: FrameFiles) -> Frame:
    return made.frame(files.timestamp_s, rotation_tracker.left(files))


def _read_colors(made: Preparation, rotation_tracker: _ImageRotation, files: FrameFiles) -> np.ndarray:
    return made.flat(rotation_tracker.left_rgb(files))


def _read_pair(made: Preparation, rotation_tracker: _ImageRotation, files: FrameFiles) -> Frame:
    return made.frame(files.timestamp_s, rotation_tracker.left(files), rotation_tracker.right(files))


def _read_with_depth(
    made: Preparation, rotation_tracker: _ImageRotation, files: FrameFiles, *, unit: float
) -> Frame:
    assert files.depth is not None
    depth = np.nan_to_num(read_png16(files.depth, 1.0), nan=0.0)
    depth = np.where(depth == FAR_MM, 0.0, depth / unit).astype(np.float32)
    return made.frame(files.timestamp_s, rotation_tracker.left(files), depth)
