"""Units of an IMU log: conversion to rad/s, m/s^2 and seconds where the unit is certain or stated, else a named refusal.

Gravity is present in all accelerometer values: the median norm is about 9.8 m/s^2 for any motion. The gyroscope rotates
gravity's direction in IMU axes, u(t2) = R^T u(t1), which shows the gyroscope's unit whenever the IMU tilts. In axes that the
gyroscope keeps fixed, the mean specific force over many seconds has the norm of gravity: velocities stay finite.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rotation3
from epipole.io._time_units import unit_of_clock

ACCEL_UNITS = {"m/s^2": 1.0, "g": 9.80665, "mg": 0.00980665}
"""Factor to m/s^2."""
GYRO_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
"""Factor to rad/s."""
_MIN_SAMPLES = 10
"""Fewer samples are not checked."""
_ACCEL_M_S2 = 5.0, 25.0
"""Plausible median norms for an IMU that is carried, driven or flown."""
_ACCEL_UNITS = (
    (0.7, 1.4, "g", "state the unit with --imu-units g"),
    (700.0, 1400.0, "thousandths of g", "state the unit with --imu-units mg"),
)
_MEDIAN_ROTATION_RAD_S, _FAST_ROTATION_RAD_S = 5.0, 20.0
"""Median and 95th percentile of the angular speed above which the unit must be degrees: 290 and 1150 deg/s."""
_RAD = GYRO_UNITS["deg/s"]
_FASTEST = 1e5
"""No gyroscope measures more, in deg/s."""
_WINDOW_S = 0.25
_MIN_WINDOWS = 8
_CONTRADICTION, _MIN_TILT_RAD = 3.0, 0.05
"""Degrees are assumed if gravity's direction is off by at least this factor more, and by this angle, with angular
velocities in rad/s than in deg/s."""
_SPAN_WINDOWS, _MIN_SPANS = 40, 3
"""Spans of 10 s over which motion averages out; linear acceleration alone would gain 100 km/h in three spans of 1 m/s^2."""
_NEAR_G = 0.05
"""Largest relative deviation of a span's mean specific force from 1 g: gain, bias, and motion."""
_MAX_SLOPE_RATIO, _MAX_SLOPE_SIGMA, _MIN_CORRELATION = 1.3, 0.1, 0.4
"""Limits for the rotation of gravity's direction per rotation in deg/s, which is 1 if that is the unit."""
_STEPS = ((2e5, "nanoseconds", 1e9), (200.0, "microseconds", 1e6), (0.2, "milliseconds", 1e3))
"""Smallest median time between samples for each unit: IMUs run at 5 to 5000 Hz."""


def seconds_of_imu(path: Path, times: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Times in seconds, and a note about their unit if it was another.

    Raises:
        FileFormatError: samples are too far apart for an IMU.
    """
    clock = unit_of_clock(times)
    steps = np.diff(np.sort(times))
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    found = next(((name, divisor) for least, name, divisor in _STEPS if step >= least), None)
    if found is None or len(times) < _MIN_SAMPLES:
        return (times, ()) if clock is None else (times * clock[0], ())
    name, divisor = found
    if name == "nanoseconds":
        return times / divisor, ()
    if clock is not None and clock[1] == name:
        return times / divisor, (f"{path.name}: its times are in {name}",)
    raise FileFormatError(
        path,
        f"its samples are {step:g} apart, more than the 0.2 s of any IMU: its times are probably in {name} "
        f"(divide them by {divisor:g})",
    )


def in_si_units(
    path: Path, timestamp_s: np.ndarray, gyro: np.ndarray, accel: np.ndarray, units: str = ""
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Angular velocities in rad/s and specific forces in m/s^2, and notes about what was converted without being asked.

    Args:
        path: the log, for messages.
        timestamp_s: (n,) increasing.
        gyro: (n, 3) angular velocities.
        accel: (n, 3) specific forces.
        units: stated units such as "g,deg/s"; units that are not stated are determined from the measurements.

    Raises:
        FileFormatError: a unit is neither stated nor certain, the measurements contradict it, or they are without gravity.
        ConfigError: unknown units.
    """
    accel_unit, gyro_unit = _stated(units)
    notes = []
    if gyro_unit is None and _is_in_degrees(timestamp_s, gyro, accel):
        gyro_unit = "deg/s"
        notes.append(
            f"{path.name}: its angular velocities are in degrees per second; they were converted to rad/s"
        )
    gyro = gyro if gyro_unit is None else gyro * GYRO_UNITS[gyro_unit]
    if accel_unit is None and _is_in_g(timestamp_s, gyro, accel):
        accel_unit = "g"
        notes.append(f"{path.name}: its accelerations are in g; they were converted to m/s^2")
    accel = accel if accel_unit is None else accel * ACCEL_UNITS[accel_unit]
    _check_units(path, timestamp_s, gyro, accel, is_gyro_known=gyro_unit is not None)
    return gyro, accel, tuple(notes)


def _stated(units: str) -> tuple[str | None, str | None]:
    """Units of the accelerometer and of the gyroscope, None for each that is not stated."""
    words = [word.strip().replace("m/s2", "m/s^2") for word in units.split(",") if word.strip()]
    accel, gyro = ([word for word in words if word in known] for known in (ACCEL_UNITS, GYRO_UNITS))
    if len(accel) > 1 or len(gyro) > 1 or len(accel) + len(gyro) != len(words):
        raise ConfigError(
            f"IMU units must be one of {', '.join(ACCEL_UNITS)} and one of {', '.join(GYRO_UNITS)}, such as g,deg/s, got {units!r}"
        )
    return accel[0] if accel else None, gyro[0] if gyro else None


def _is_in_degrees(times: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> bool:
    """Whether gravity's direction rotates as angular velocities in degrees per second say, and not as in rad/s."""
    if len(times) < _MIN_SAMPLES or np.abs(gyro).max() > _FASTEST:
        return False
    plain, reduced = (_tilt_error_rad(_windows(times, factor * gyro, accel)) for factor in (1.0, _RAD))
    if plain <= max(_MIN_TILT_RAD, _CONTRADICTION * reduced):
        return False
    found = _windows(times, _RAD * gyro, accel)
    # u' - u = u x (slope theta + bias) for small rotations theta; the bias is eliminated from both sides.
    before = found.direction[:-1]
    by_bias = np.stack([np.cross(before, axis) for axis in np.eye(3)], axis=2).reshape(-1, 3)
    sides = np.stack(
        [np.cross(before, found.rotation_rad), np.diff(found.direction, axis=0)], axis=2
    ).reshape(-1, 2)
    expected, change = (sides - by_bias @ np.linalg.lstsq(by_bias, sides, rcond=None)[0]).T
    power = float(expected @ expected)
    if power == 0.0 or not change.any():
        return False
    slope = float(expected @ change) / power
    sigma = float(np.sqrt(((change - slope * expected) ** 2).mean() / power))
    correlation = float(expected @ change) / float(np.sqrt(power * (change @ change)))
    is_one = 1.0 / _MAX_SLOPE_RATIO < slope < _MAX_SLOPE_RATIO and sigma < _MAX_SLOPE_SIGMA
    return is_one and correlation > _MIN_CORRELATION


def _is_in_g(times: np.ndarray, gyro_rad_s: np.ndarray, accel: np.ndarray) -> bool:
    """Whether the mean specific force of every span, in axes that the gyroscope keeps fixed, is 1."""
    low, high, *_ = _ACCEL_UNITS[0]
    if len(times) < _MIN_SAMPLES or not low <= float(np.median(np.linalg.norm(accel, axis=1))) <= high:
        return False
    found = _windows(times, gyro_rad_s, accel)
    num_spans = len(found.force) // _SPAN_WINDOWS
    if num_spans < _MIN_SPANS:
        return False
    rotations = Rotation3.exp(found.rotation_rad).matrix
    for span in range(num_spans):
        fixed_from_imu, total = np.eye(3), np.zeros(3)
        for row in range(span * _SPAN_WINDOWS, (span + 1) * _SPAN_WINDOWS):
            total += fixed_from_imu @ found.force[row]
            if row < len(rotations):
                fixed_from_imu = fixed_from_imu @ rotations[row]
        if abs(np.linalg.norm(total) / _SPAN_WINDOWS - 1.0) > _NEAR_G:
            return False
    return True


def _check_units(
    path: Path, timestamp_s: np.ndarray, gyro: np.ndarray, accel: np.ndarray, *, is_gyro_known: bool
) -> None:
    """Check that measurements are plausible in rad/s and m/s^2 and include gravity.

    Args:
        path: the log, for error messages.
        timestamp_s: (n,) increasing.
        gyro: (n, 3) angular velocities.
        accel: (n, 3) specific forces.
        is_gyro_known: whether the gyroscope's unit was stated or determined, so that its speed is that of the motion.

    Raises:
        FileFormatError: they are in another unit, without gravity, or in another column order.
    """
    if len(timestamp_s) < _MIN_SAMPLES:
        return
    acceleration, rotation = (float(np.median(np.linalg.norm(values, axis=1))) for values in (accel, gyro))
    low, high = _ACCEL_M_S2
    said = f"the median norm of its accelerations is {acceleration:.3g}, but gravity alone is 9.81 m/s^2"
    if not low <= acceleration <= high:
        if low <= rotation <= high:
            is_g = _ACCEL_UNITS[0][0] <= acceleration <= _ACCEL_UNITS[0][1]
            units = ", or state the units with --imu-units g,deg/s if they are these" if is_g else ""
            raise FileFormatError(
                path,
                f"{said}, and that of its angular velocities is {rotation:.3g}: the columns must be time, wx wy wz, ax ay az{units}",
            )
        raise FileFormatError(path, f"{said}: {_why(acceleration)}")
    fast = float(np.percentile(np.linalg.norm(gyro, axis=1), 95.0))
    if not is_gyro_known and (rotation > _MEDIAN_ROTATION_RAD_S or fast > _FAST_ROTATION_RAD_S):
        raise FileFormatError(
            path,
            f"its angular velocities have a median norm of {rotation:.3g} and reach {fast:.3g}, too fast for rad/s: they are probably in "
            "degrees per second (state the unit with --imu-units deg/s, or rad/s if it does rotate this fast)",
        )
    plain, reduced = (_tilt_error_rad(_windows(timestamp_s, factor * gyro, accel)) for factor in (1.0, _RAD))
    if plain > _MIN_TILT_RAD and plain > _CONTRADICTION * reduced:
        raise FileFormatError(
            path,
            f"its angular velocities rotate gravity's direction {plain / reduced:.0f} times more than its accelerations show, but agree "
            "better with them if read as degrees per second: "
            + (
                "check the axes, and the unit that --imu-units states"
                if is_gyro_known
                else "check the unit and the axes, and state the unit with --imu-units"
            ),
        )


def _why(acceleration: float) -> str:
    without = "gravity was removed (the specific force with gravity is needed, as sensors measure it)"
    for low, high, name, remedy in _ACCEL_UNITS:
        if low <= acceleration <= high:
            return f"it is probably in {name} ({remedy})" + (f", or {without}" if name == "g" else "")
    return (
        f"probably {without}"
        if acceleration < _ACCEL_M_S2[0]
        else "it is in raw counts, or in another unit than m/s^2"
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    """Means over short windows."""

    force: np.ndarray
    """(w, 3) specific force."""
    direction: np.ndarray
    """(w, 3) unit vectors of it."""
    rotation_rad: np.ndarray
    """(w - 1, 3) the gyroscope's rotation from the center of each window to that of the next one."""


def _windows(times: np.ndarray, gyro_rad_s: np.ndarray, accel: np.ndarray) -> _Windows:
    window = np.floor((times - times[0]) / _WINDOW_S).astype(np.int64)
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    counts = np.diff([*starts, len(times)])
    middle_s = np.add.reduceat(times, starts) / counts
    force = np.add.reduceat(accel, starts) / counts[:, None]
    direction = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-12)
    # Integral of the angular velocity up to each sample; between window centers, it is the rotation, if small.
    step_s = np.diff(times, prepend=times[0])
    traveled = np.cumsum(gyro_rad_s * step_s[:, None], axis=0)
    at_middle = np.stack([np.interp(middle_s, times, traveled[:, axis]) for axis in range(3)], axis=1)
    return _Windows(force, direction, np.diff(at_middle, axis=0))


def _tilt_error_rad(found: _Windows) -> float:
    """Median angle between gravity in a window and the previous one's rotated by the gyroscope; 0 for few windows."""
    if len(found.direction) < _MIN_WINDOWS:
        return 0.0
    predicted = np.einsum("nji,nj->ni", Rotation3.exp(found.rotation_rad).matrix, found.direction[:-1])
    cosine = np.clip(np.einsum("ni,ni->n", predicted, found.direction[1:]), -1.0, 1.0)
    return float(np.median(np.arccos(cosine)))
