"""Checks that an IMU log is in rad/s and m/s^2 and its times in seconds; other units are named and rejected.

Gravity is present in all accelerometer values: the median norm is about 9.8 m/s^2 for any motion. The gyroscope rotates
gravity's direction in IMU axes, u(t2) = R^T u(t1), which shows the gyroscope's unit whenever the IMU tilts.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.geometry import Rotation3
from epipole.io._time_units import unit_of_clock

_MIN_SAMPLES = 10
"""Fewer samples are not checked."""
_ACCEL_M_S2 = 5.0, 25.0
"""Plausible median norms for an IMU that is carried, driven or flown."""
_ACCEL_UNITS = (
    (0.7, 1.4, "g", "multiply it by 9.80665"),
    (700.0, 1400.0, "thousandths of g", "multiply it by 0.00980665"),
)
_MEDIAN_ROTATION_RAD_S, _FAST_ROTATION_RAD_S = 5.0, 20.0
"""Median and 95th percentile of the angular speed above which the unit must be degrees: 290 and 1150 deg/s."""
_RAD = np.pi / 180.0
_WINDOW_S = 0.25
_MIN_WINDOWS = 8
_CONTRADICTION, _MIN_TILT_RAD = 3.0, 0.05
"""Degrees are assumed if gravity's direction is off by at least this factor more, and by this angle, with angular
velocities in rad/s than in deg/s."""
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


def check_imu_units(path: Path, timestamp_s: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> None:
    """Check that measurements are plausible in rad/s and m/s^2 and include gravity.

    Args:
        path: the log, for error messages.
        timestamp_s: (n,) increasing.
        gyro: (n, 3) angular velocities.
        accel: (n, 3) specific forces.

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
            raise FileFormatError(
                path,
                f"{said}, and that of its angular velocities is {rotation:.3g}: the columns must be time, wx wy wz, ax ay az",
            )
        raise FileFormatError(path, f"{said}: {_why(acceleration)}")
    fast = float(np.percentile(np.linalg.norm(gyro, axis=1), 95.0))
    if rotation > _MEDIAN_ROTATION_RAD_S or fast > _FAST_ROTATION_RAD_S:
        raise FileFormatError(
            path,
            f"its angular velocities have a median norm of {rotation:.3g} and reach {fast:.3g}, too fast for rad/s: they are probably in "
            "degrees per second (multiply them by pi / 180)",
        )
    plain, reduced = (_tilt_error_rad(timestamp_s, factor * gyro, accel) for factor in (1.0, _RAD))
    if plain > _MIN_TILT_RAD and plain > _CONTRADICTION * reduced:
        raise FileFormatError(
            path,
            f"its angular velocities rotate gravity's direction {plain / reduced:.0f} times more than its accelerations show, but agree "
            "with them if read as degrees per second: multiply them by pi / 180",
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


def _tilt_error_rad(times: np.ndarray, gyro_rad_s: np.ndarray, accel: np.ndarray) -> float:
    """Median angle between gravity in a window and the previous one's rotated by the gyroscope; 0 for few windows."""
    window = np.floor((times - times[0]) / _WINDOW_S).astype(np.int64)
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    counts = np.diff([*starts, len(times)])
    if len(starts) < _MIN_WINDOWS:
        return 0.0
    middle_s = np.add.reduceat(times, starts) / counts
    direction = np.add.reduceat(accel, starts) / counts[:, None]
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    # Integral of the angular velocity up to each sample; between window centers, it is the rotation, if small.
    step_s = np.diff(times, prepend=times[0])
    traveled = np.cumsum(gyro_rad_s * step_s[:, None], axis=0)
    at_middle = np.stack([np.interp(middle_s, times, traveled[:, axis]) for axis in range(3)], axis=1)
    rotations = Rotation3.exp(np.diff(at_middle, axis=0)).matrix
    foretold = np.einsum("nji,nj->ni", rotations, direction[:-1])
    cosine = np.clip(np.einsum("ni,ni->n", foretold, direction[1:]), -1.0, 1.0)
    return float(np.median(np.arccos(cosine)))
