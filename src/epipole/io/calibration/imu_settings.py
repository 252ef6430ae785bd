"""What a calibration file states about an IMU: its mounting on the first camera, the offset of its clock, and its noise.

| program | mounting | clock | noise |
|---|---|---|---|
| Kalibr, OpenVINS | T_cam_imu, T_imu_cam | timeshift_cam_imu: t_imu = t_cam + shift | gyroscope_noise_density, ... |
| EuRoC | T_BS, which is imu_from_camera | | gyroscope_noise_density, ... |
| ORB-SLAM3 | IMU.T_b_c1 or Tbc, which are imu_from_camera | | IMU.NoiseGyro, ... |
| OKVIS | T_SC of the first camera, which is imu_from_camera | | sigma_g_c, ... in imu_params |
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.inertial import ImuNoise
from epipole.io._named_numbers import numbers_of
from epipole.io.calibration.camera_chains import camera_from_imu, motion_of
from epipole.io.calibration.slam_settings import is_okvis, square_motion

_DENSITIES = {
    "gyro_density": ("gyroscope_noise_density", "IMU.NoiseGyro", "sigma_g_c"),
    "accel_density": ("accelerometer_noise_density", "IMU.NoiseAcc", "sigma_a_c"),
    "gyro_walk": ("gyroscope_random_walk", "IMU.GyroWalk", "sigma_gw_c"),
    "accel_walk": ("accelerometer_random_walk", "IMU.AccWalk", "sigma_aw_c"),
}
"""Names of the continuous-time densities of `ImuNoise`, which have the same units in all programs."""
_ORB_SLAM = ("IMU.T_b_c1", "Tbc")
_LARGEST_SHIFT_S = 10.0


def mounting_of(path: Path, content: Mapping[str, Any]) -> Rigid3 | None:
    """camera_from_imu of the first camera; None if the file has none of the keys but possibly T_BS.

    Raises:
        FileFormatError: the matrix is not a rigid motion.
    """
    own = content.get("cam0", content)
    if isinstance(own, Mapping) and (found := camera_from_imu(path, own)) is not None:
        return found
    if is_okvis(content):
        first = content["cameras"][0]
        return motion_of(path, first, "T_SC").inverse() if isinstance(first, Mapping) else None
    key = next((key for key in _ORB_SLAM if key in content), None)
    return None if key is None else square_motion(path, content, key).inverse()


def clock_offset_of(path: Path, content: Mapping[str, Any]) -> float:
    """Seconds by which the IMU's clock is ahead of the first camera's; zero if the file does not say.

    Raises:
        FileFormatError: it is not a number of seconds.
    """
    own = content.get("cam0", content)
    if not isinstance(own, Mapping) or "timeshift_cam_imu" not in own:
        return 0.0
    shift_s = float(numbers_of(path, own, "timeshift_cam_imu", 1)[0])
    if not abs(shift_s) <= _LARGEST_SHIFT_S:
        raise FileFormatError(
            path, f"timeshift_cam_imu is {shift_s:g} s: it must be below {_LARGEST_SHIFT_S:g} s"
        )
    return shift_s


def noise_of(content: Mapping[str, Any]) -> ImuNoise | None:
    """Noise densities, with defaults for those that are missing; None if all are."""
    listed = content.get("imu_params")
    values = {**content, **(listed if isinstance(listed, Mapping) else {})}
    known = {}
    for name, keys in _DENSITIES.items():
        for key in keys:
            try:
                value = float(values[key])
            except (KeyError, TypeError, ValueError):
                continue
            if 0 < value < np.inf:
                known[name] = value
    return ImuNoise(**known) if known else None
