"""The content of COLMAP model files, with COLMAP's ids and pixels.

Poses are seven numbers, the quaternion (w, x, y, z) and the translation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64, UInt8

CAMERA_SENSOR = 0
SENSOR_TYPES = ("CAMERA", "IMU")
NO_POINT = -1

FILE_NAMES = ("cameras", "rigs", "frames", "images", "points3D")


class CameraRecord(NamedTuple):
    """A line of cameras."""

    id: int
    model_id: int
    width: int
    height: int
    params: np.ndarray


class SensorRecord(NamedTuple):
    """A sensor of a rig; the first of a rig is the reference, whose pose is the identity."""

    type: int
    id: int
    sensor_from_rig: np.ndarray
    """(7,); NaN where unknown."""


class RigRecord(NamedTuple):
    """A line of rigs."""

    id: int
    sensors: tuple[SensorRecord, ...]


class DataRecord(NamedTuple):
    """One measurement of a sensor in a frame: an image, for a camera."""

    sensor_type: int
    sensor_id: int
    data_id: int


class FrameRecord(NamedTuple):
    """A line of frames."""

    id: int
    rig_id: int
    rig_from_world: np.ndarray
    """(7,)."""
    data: tuple[DataRecord, ...]


class ImageRecord(NamedTuple):
    """Two lines of images."""

    id: int
    cam_from_world: np.ndarray
    """(7,)."""
    camera_id: int
    name: str
    keypoints: np.ndarray
    """(k, 2)."""
    point_ids: np.ndarray
    """(k,) int64, -1 for none."""


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """All points, with their tracks as compressed rows."""

    ids: Int64[np.ndarray, " n"]
    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    error: Float64[np.ndarray, " n"]
    track_offsets: Int64[np.ndarray, " n1"]
    track_image_ids: Int64[np.ndarray, " k"]
    track_keypoints: Int64[np.ndarray, " k"]


@dataclass(frozen=True, slots=True, eq=False)
class ColmapTables:
    """A model; rigs and frames are None in models from versions without them."""

    cameras: list[CameraRecord]
    rigs: list[RigRecord] | None
    frames: list[FrameRecord] | None
    images: list[ImageRecord]
    points: PointTable


IDENTITY_POSE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
UNKNOWN_POSE = np.full(7, np.nan)
