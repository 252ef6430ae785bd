"""IMU logs (EuRoC's folder or CSV, any table with seven columns, a ROS recording) and the IMU's extrinsics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.inertial import ImuLog, ImuNoise, MountedImu
from epipole.io.bags.recording import is_bag, read_bag_imu
from epipole.io.calibration.files import parsed_file, read_body_from_camera
from epipole.io.calibration.imu_settings import clock_offset_of, mounting_of, noise_of
from epipole.io.files import file_text
from epipole.io.sequences.imu_order import in_order
from epipole.io.sequences.imu_units import in_si_units, seconds_of_imu

_COLUMNS = 7


@checked
def read_imu(path: str | Path, units: str = "", topic: str = "") -> tuple[ImuLog, ImuNoise]:
    """Read an IMU log: angular velocities (rad/s) and specific forces (m/s^2).

    Unordered rows are sorted, repeated times dropped, and measurements that are certain to be in g or degrees per second
    converted; the log's `notes` report it.

    Args:
        path: EuRoC's `imu0` folder or its `data.csv` (noise is read from the `sensor.yaml` beside it), a text file with
            `SECONDS wx wy wz ax ay az` per line (or nanoseconds), or a ROS recording.
        units: units of the measurements, such as "g,deg/s" (see `epipole.io.sequences.imu_units`); empty: found by content.
        topic: that of a ROS recording with several IMUs, as in `read_bag_imu`; empty: there is only one.

    Raises:
        FileFormatError: the file is missing, a line is malformed, times belong to several recordings, or measurements
            are in another unit that is neither stated nor certain, or without gravity.
        ConfigError: unknown units, or the topic is not that of an IMU in a recording.
        MissingDependencyError: the package rosbags is required and not installed.
    """
    path = Path(path)
    if is_bag(path):
        return read_bag_imu(path, topic or None, units), ImuNoise()
    if topic:
        raise ConfigError(f"{path} is not a ROS recording: it has no topic {topic}")
    table = path / "data.csv" if path.is_dir() else path
    values = _table(table)
    values[:, 0], said = seconds_of_imu(table, values[:, 0])
    values, more = in_order(table, values)
    gyro, accel, converted = in_si_units(table, values[:, 0], values[:, 1:4], values[:, 4:7], units)
    about = table.with_name("sensor.yaml")
    stated = noise_of(parsed_file(about)) if about.is_file() else None
    log = ImuLog(values[:, 0].copy(), gyro.copy(), accel.copy(), (*said, *more, *converted))
    return log, stated or ImuNoise()


@checked
def read_camera_from_imu(path: str | Path) -> Rigid3:
    """Read camera_from_imu of the first camera from a file of Kalibr, OpenVINS, EuRoC, ORB-SLAM3 or OKVIS (see `imu_settings`).

    The IMU may be any point on the body; odometry measured at the center of the wheel axle uses the same format.

    Raises:
        FileFormatError: the file has none of these keys.
    """
    path = Path(path)
    found = mounting_of(path, parsed_file(path))
    return read_body_from_camera(path).inverse() if found is None else found


@checked
def read_mounted_imu(path: str | Path, mounting: str | Path, units: str = "", topic: str = "") -> MountedImu:
    """Read an IMU log with the IMU's mounting, and what the file of the mounting states about clock and noise.

    Args:
        path: the log, as for `read_imu`; noise beside it counts before that of the mounting.
        mounting: the file of the mounting, as for `read_camera_from_imu`. With an offset of the IMU's clock (timeshift_cam_imu),
            the log gets the times of the camera's clock, and a note.
        units: as for `read_imu`.
        topic: as for `read_imu`.

    Raises:
        FileFormatError, ConfigError, MissingDependencyError: as of the two.
    """
    (log, noise), mounting = read_imu(path, units, topic), Path(mounting)
    content = parsed_file(mounting)
    offset_s, stated = clock_offset_of(mounting, content), noise_of(content)
    if offset_s:
        note = f"{mounting.name}: the IMU's clock is {1e3 * offset_s:g} ms ahead of the camera's (timeshift_cam_imu): corrected"
        log = replace(log, timestamp_s=log.timestamp_s - offset_s, notes=(*log.notes, note))
    if stated is not None and noise == ImuNoise():
        noise = stated
    return MountedImu(log, read_camera_from_imu(mounting), noise)


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
