"""Whether an IMU's measurements fit the trajectory far better if they are read differently: another sign, or another unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.inertial import ImuLog, MountedImu, align_path_to_imu

LARGEST_MISFIT = 5.0
"""Ratio to the specified noise up to which measurements agree: 1.3 to 3.5 on the EuRoC flights, 30 with the log of a different trajectory."""
CLEARER = 0.5
"""Another reading must reduce the misfit to this fraction: a gentle ride with the opposite sign had 0.15 instead of 3.6."""
LEAST_MISFIT = 1.0
"""Measurements that fit within their specified noise are read correctly."""
_SIGN = "its accelerations have the opposite sign, 1 g downward at rest: negate them"
_UNIT = "its angular velocities are in degrees per second: state that with --imu-units deg/s"
_READINGS = (
    (np.pi / 180.0, 1.0, _UNIT),
    (1.0, -1.0, _SIGN),
    (np.pi / 180.0, -1.0, f"{_UNIT}; {_SIGN}"),
)
"""Factors of angular velocities and accelerations, and what they mean."""


def better_reading(
    timestamp_s: np.ndarray, world_from_camera: Rigid3, imu: MountedImu, misfit: float, *, is_metric: bool
) -> str:
    """How the measurements are to be read instead, in words; empty if no other reading fits far better.

    Args:
        timestamp_s: (n,) times of the poses by the IMU's clock.
        world_from_camera: (n,) poses.
        imu: the IMU as given.
        misfit: of `align_path_to_imu` as given; infinite if it does not fit at all.
        is_metric: whether the poses are in meters.
    """
    if misfit <= LEAST_MISFIT:
        return ""
    near = imu.log.between(float(timestamp_s[0]), float(timestamp_s[-1]))
    found = [(min(CLEARER * misfit, LARGEST_MISFIT), "")]
    for gyro_factor, accel_factor, words in _READINGS:
        log = ImuLog(near.timestamp_s, gyro_factor * near.gyro_rad_s, accel_factor * near.accel_m_s2)
        try:
            other = align_path_to_imu(
                timestamp_s, world_from_camera, replace(imu, log=log), is_metric=is_metric
            )
        except DegenerateGeometryError:
            continue
        found.append((other.misfit, words))
    return min(found)[1]
