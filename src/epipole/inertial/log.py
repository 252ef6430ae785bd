"""IMU measurements and noise parameters."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from epipole._checks import Declared, check_fields, checked
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3

LAST_VALID_S = 0.05
"""Longest time after the last sample for which it is taken to be valid."""
LARGEST_NOISE = 1e6
"""Limit of noise parameters, in their units: beyond it, squares overflow."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuLog(Declared):
    """Angular velocities and specific forces (acceleration minus gravity), in the IMU's own axes."""

    timestamp_s: Float64[np.ndarray, " n"]
    gyro_rad_s: Float64[np.ndarray, "n 3"]
    accel_m_s2: Float64[np.ndarray, "n 3"]
    notes: tuple[str, ...] = ()
    """Corrections made to the file's rows, in words."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ShapeError: a value is not finite, or the times do not increase.
        """
        check_fields(self)
        values = (self.timestamp_s, self.gyro_rad_s, self.accel_m_s2)
        if not all(np.isfinite(value).all() for value in values):
            raise ShapeError("IMU times and measurements must be finite")
        if (np.diff(self.timestamp_s) <= 0).any():
            raise ShapeError("IMU times must increase")

    def between(self, start_s: float, stop_s: float) -> ImuLog:
        """The samples that cover a span of time, as far as there are any; the last stays valid for LAST_VALID_S after the log's end.

        Frames often arrive before the last measurements.
        """
        times = self.timestamp_s
        first = max(int(np.searchsorted(times, start_s, side="right")) - 1, 0)
        last = int(np.searchsorted(times, stop_s, side="left")) + 1
        rows = np.arange(first, min(last, len(times)))
        if len(rows) and 0 < stop_s - times[rows[-1]] <= LAST_VALID_S:
            rows = np.append(rows, rows[-1])
            return ImuLog(np.append(times[rows[:-1]], stop_s), self.gyro_rad_s[rows], self.accel_m_s2[rows])
        return ImuLog(times[rows], self.gyro_rad_s[rows], self.accel_m_s2[rows])

    def __len__(self) -> int:
        return len(self.timestamp_s)

    def __repr__(self) -> str:
        if len(self) < 2:
            return f"ImuLog({len(self)} samples)"
        span = float(self.timestamp_s[-1] - self.timestamp_s[0])
        return f"ImuLog({len(self)} samples, {span:.1f} s, {(len(self) - 1) / span:.0f} Hz)"


class ImuBuffer:
    """A log that grows as measurements arrive; adding one takes constant time on average.

    Attributes:
        log: all measurements so far; earlier values of this attribute stay as they were.
    """

    @checked
    def __init__(self, log: ImuLog) -> None:
        self.log = log
        self._notes = log.notes
        self._times, self._values = log.timestamp_s, np.concatenate([log.gyro_rad_s, log.accel_m_s2], axis=1)

    @checked
    def add(self, samples: ImuLog) -> None:
        """Append measurements.

        Raises:
            ShapeError: they are not later than those before.
        """
        old, new = len(self.log), len(self.log) + len(samples)
        if old and len(samples) and samples.timestamp_s[0] <= self.log.timestamp_s[-1]:
            raise ShapeError(
                f"IMU times must increase: {samples.timestamp_s[0]:.6f} s after {self.log.timestamp_s[-1]:.6f} s"
            )
        if new > len(self._times):
            room = max(2 * new, 1024)
            self._times = np.resize(self._times[:old], room) if old else np.zeros(room)
            self._values = np.resize(self._values[:old], (room, 6)) if old else np.zeros((room, 6))
        self._times[old:new] = samples.timestamp_s
        self._values[old:new, :3], self._values[old:new, 3:] = samples.gyro_rad_s, samples.accel_m_s2
        # Its parts are checked; to check all of it again for each new sample would take longer and longer.
        self.log = object.__new__(ImuLog)
        columns = self._times[:new], self._values[:new, :3], self._values[:new, 3:], self._notes
        for name, value in zip(ImuLog.__slots__, columns):
            object.__setattr__(self.log, name, value)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuNoise:
    """Noise densities and bias random walks (continuous time, as in Kalibr and EuRoC).

    The defaults are those of a common MEMS IMU (ADIS16448, as in EuRoC).
    """

    gyro_density: float = 1.7e-4
    """rad / s / sqrt(Hz)."""
    accel_density: float = 2.0e-3
    """m / s^2 / sqrt(Hz)."""
    gyro_walk: float = 2.0e-5
    """rad / s^2 / sqrt(Hz)."""
    accel_walk: float = 3.0e-3
    """m / s^3 / sqrt(Hz)."""
    gyro_bias_sigma: float = 0.1
    """rad / s, prior standard deviation of the bias."""
    accel_bias_sigma: float = 0.3
    """m / s^2, prior standard deviation of the bias."""
    accel_gain_sigma: float = 0.01
    """Relative uncertainty of the accelerometer's gain: it scales the result, and no motion reveals it."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is not positive, or no sensor is that bad.
        """
        check_fields(self)
        for name in self.__slots__:
            if not 0 < getattr(self, name) < LARGEST_NOISE:
                raise ConfigError(
                    f"{name} must be positive and below {LARGEST_NOISE:g}, got {getattr(self, name)}"
                )


@dataclass(frozen=True, slots=True, eq=False)
class MountedImu(Declared):
    """Measurements of an IMU mounted on a camera."""

    log: ImuLog
    camera_from_imu: Rigid3
    """In meters."""
    noise: ImuNoise = field(default_factory=ImuNoise)

    def __repr__(self) -> str:
        return f"MountedImu({self.log!r})"
