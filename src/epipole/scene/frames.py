"""Rigs of cameras that move together, and frames: instants at which they took images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32

from epipole._checks import Declared, check_count, checked
from epipole.geometry import Rigid3


@dataclass(frozen=True, slots=True, eq=False)
class Rigs(Declared):
    """Rigs in compressed rows: rig r has the sensors sensor_offsets[r] to sensor_offsets[r + 1].

    The first sensor of a rig is its reference (identity). A single camera is a rig of one sensor.
    """

    sensor_offsets: Int32[np.ndarray, " r1"]
    sensor_camera: Int32[np.ndarray, " s"]
    cam_from_rig: Rigid3

    @staticmethod
    @checked
    def of_single_cameras(num_cameras: int) -> Rigs:
        """One rig per camera, with that camera as its only sensor."""
        check_count(num_cameras, "num_cameras")
        ids = np.arange(num_cameras + 1, dtype=np.int32)
        return Rigs(ids, ids[:-1].copy(), Rigid3.identity(num_cameras))

    def __len__(self) -> int:
        return len(self.sensor_offsets) - 1

    def rig_of_sensor(self) -> Int32[np.ndarray, " s"]:
        """The rig of each sensor."""
        return np.repeat(np.arange(len(self), dtype=np.int32), np.diff(self.sensor_offsets))

    def __repr__(self) -> str:
        return f"Rigs({len(self)} rigs, {len(self.sensor_camera)} sensors)"


@dataclass(frozen=True, slots=True, eq=False)
class Frames(Declared):
    """One row per instant of one rig."""

    rig: Int32[np.ndarray, " n"]
    rig_from_world: Rigid3
    """NaN where the frame is not registered."""
    timestamp_s: Float64[np.ndarray, " n"]
    """Seconds; NaN where unknown."""

    def is_registered(self) -> Bool[np.ndarray, " n"]:
        """Mask of frames with a known pose."""
        return np.isfinite(self.rig_from_world.translation).all(axis=1)

    def __len__(self) -> int:
        return len(self.rig)

    def __repr__(self) -> str:
        return f"Frames({len(self)}, {int(self.is_registered().sum())} registered)"


@checked
def unregistered(count: int) -> Rigid3:
    """Rigid3 rows of NaN: unknown poses."""
    check_count(count, "count")
    return Rigid3(np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan))
