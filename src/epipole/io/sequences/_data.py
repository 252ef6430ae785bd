"""What a folder of frames holds."""

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
    """`frame-NNNNNN.color.*` with another calibration than 7-Scenes' (BundleFusion, 3DMatch, 12-Scenes, ScanNet v1)."""
    SCANNET = "ScanNet"
    TUM_RGBD = "TUM RGB-D"
    EUROC = "EuRoC"
    KITTI = "KITTI odometry"
    IMAGES = "images"


@dataclass(frozen=True, slots=True)
class FrameFiles:
    """The files of one instant."""

    timestamp_s: float
    image: Path
    right: Path | None = None
    depth: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SensorDepth:
    """How depth images are to be read."""

    unit: float
    """Stored values for a metre."""
    camera: Camera | None = None
    """Of the sensor; None: the color camera's, images being registered."""
    depth_from_color: Rigid3 | None = None
    unit_source: str = ""
    """Where the unit comes from, in words."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageSequence:
    """Frames in order of time, and what the folder says of the cameras."""

    kind: SequenceKind
    frames: tuple[FrameFiles, ...]
    camera: Camera | None
    """None where it is unknown."""
    rig: StereoRig | None = None
    depth: SensorDepth | None = None
    warnings: tuple[str, ...] = ()
    """What is odd about the folder, or was assumed without proof, in words."""
    camera_source: str = ""
    """Where the camera comes from, in words."""
    camera_problem: str = ""
    """Why the calibration that lies beside the images cannot be used; empty where there is none, or it is used."""

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        seconds = self.frames[-1].timestamp_s - self.frames[0].timestamp_s
        return f"ImageSequence({self.kind.value}, {len(self)} frames over {seconds:.1f} s)"
