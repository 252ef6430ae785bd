"""The content of a folder of frames."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.scene import StereoRig


class SequenceKind(StrEnum):
    """The layout of a folder of frames."""

    SEVEN_SCENES = "7-Scenes"
    RGBD_FRAMES = "RGB-D frames"
    """`frame-NNNNNN.color.*` with another calibration than 7-Scenes (BundleFusion, 3DMatch, 12-Scenes, ScanNet v1)."""
    SCANNET = "ScanNet"
    TUM_RGBD = "TUM RGB-D"
    EUROC = "EuRoC"
    KITTI = "KITTI odometry"
    IMAGES = "images"


@dataclass(frozen=True, slots=True)
class FrameFiles:
    """The files of one frame."""

    timestamp_s: float
    image: Path
    right: Path | None = None
    depth: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SensorDepth:
    """How to read the depth images."""

    unit: float
    """Stored values per meter."""
    camera: Camera | None = None
    """The depth camera; None: the color camera, to which the depth images are registered."""
    depth_from_color: Rigid3 | None = None
    unit_source: str = ""
    """Where the unit comes from."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageSequence:
    """Frames in order of time, and the cameras and depth found in the folder."""

    kind: SequenceKind
    frames: tuple[FrameFiles, ...]
    camera: Camera | None
    """None if unknown."""
    rig: StereoRig | None = None
    depth: SensorDepth | None = None
    warnings: tuple[str, ...] = ()
    """Problems found in the folder, and assumptions made without proof."""
    camera_source: str = ""
    """Where the camera comes from."""
    camera_problem: str = ""
    """Why the calibration next to the images cannot be used; empty if there is none, or it is used."""

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        seconds = self.frames[-1].timestamp_s - self.frames[0].timestamp_s
        return f"ImageSequence({self.kind.value}, {len(self)} frames over {seconds:.1f} s)"
