"""IMU logs (EuRoC's folder or CSV, any table with seven columns, a ROS recording) and the IMU's extrinsics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.inertial import ImuLog, ImuNoise
from epipole.io.bags.recording import is_bag, read_bag_imu
from epipole.io.calibration.camera_chains import camera_from_imu
from epipole.io.calibration.files import parsed_file, read_body_from_camera
from epipole.io.files import file_text
from epipole.io.sequences.imu_order import in_order
from epipole.io.sequences.imu_units import in_si_units, seconds_of_imu

_COLUMNS = 7
_DENSITIES = {
    "gyro_density": "gyroscope_noise_density",
    "accel_density": "accelerometer_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "accel_walk": "accelerometer_random_walk",
}


@checked
def read_imu(path: str | Path, units: str = "") -> tuple[ImuLog, ImuNoise]:
    """Read an IMU log: angular velocities (rad/s) and specific forces (m/s^2).

    Unordered rows are sorted, repeated times dropped, and measurements that are certain to be in g or degrees per second
    converted; the log's `notes` report it.

    Args:
        path: EuRoC's `imu0` folder or its `data.csv` (noise is read from the `sensor.yaml` beside it), a text file with
            `SECONDS wx wy wz ax ay az` per line (or nanoseconds), or a ROS recording with one IMU.
        units: units of the measurements, such as "g,deg/s" (see `epipole.io.sequences.imu_units`); empty: found by content.

    Raises:
        FileFormatError: the file is missing, a line is malformed, times belong to several recordings, or measurements
            are in another unit that is neither stated nor certain, or without gravity.
        ConfigError: unknown units.
        MissingDependencyError: the package rosbags is required and not installed.
    """
    path = Path(path)
    if is_bag(path):
        return read_bag_imu(path, units=units), ImuNoise()
    table = path / "data.csv" if path.is_dir() else path
    values = _table(table)
    values[:, 0], said = seconds_of_imu(table, values[:, 0])
    values, more = in_order(table, values)
    gyro, accel, converted = in_si_units(table, values[:, 0], values[:, 1:4], values[:, 4:7], units)
    about = table.with_name("sensor.yaml")
    noise = _noise(about) if about.is_file() else ImuNoise()
    log = ImuLog(values[:, 0].copy(), gyro.copy(), accel.copy(), (*said, *more, *converted))
    return log, noise


@checked
def read_camera_from_imu(path: str | Path) -> Rigid3:
    """Read camera_from_imu: `T_cam_imu` or `T_imu_cam` of the first camera (Kalibr, OpenVINS), or T_BS (EuRoC).

    The IMU may be any point on the body; odometry measured at the center of the wheel axle uses the same format.

    Raises:
        FileFormatError: the file has none of these keys.
    """
    path = Path(path)
    content = parsed_file(path)
    own = content.get("cam0", content)
    found = camera_from_imu(path, own) if isinstance(own, dict) else None
    return read_body_from_camera(path).inverse() if found is None else found


def _table(path: Path) -> np.ndarray:
    rows = []
    for number, line in enumerate(file_text(path).splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            rows.append([float(word) for word in words[:_COLUMNS]])
        except ValueError as error:
            raise FileFormatError(path, f"line {number}: {error}") from error
        if len(words) < _COLUMNS or not np.isfinite(rows[-1]).all():
            raise FileFormatError(path, f"line {number}: expected a time and six finite numbers")
    if not rows:
        raise FileFormatError(path, "it contains no IMU measurements")
    return np.array(rows)


def _noise(path: Path) -> ImuNoise:
    """Noise densities from EuRoC's sensor.yaml; defaults for missing ones."""
    content = parsed_file(path)
    known = {}
    for name, key in _DENSITIES.items():
        try:
            value = float(content[key])
        except (KeyError, TypeError, ValueError):
            continue
        if 0 < value < np.inf:
            known[name] = value
    return ImuNoise(**known)
