"""IMU measurements and noise parameters."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from epipole._checks import Declared, check_fields
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3

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

    def __len__(self) -> int:
        return len(self.timestamp_s)

    def __repr__(self) -> str:
        if len(self) < 2:
            return f"ImuLog({len(self)} samples)"
        span = float(self.timestamp_s[-1] - self.timestamp_s[0])
        return f"ImuLog({len(self)} samples, {span:.1f} s, {(len(self) - 1) / span:.0f} Hz)"


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
