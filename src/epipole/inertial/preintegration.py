"""IMU preintegration: Forster, Carlone, Dellaert and Scaramuzza, T-RO 2017."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole._checks import Declared, checked
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rotation3
from epipole.inertial import _imu_kernels as kernels
from epipole.inertial.log import ImuLog, ImuNoise

LARGEST_GAP_S = 0.1
"""Largest gap between two samples over which to integrate."""


@dataclass(frozen=True, slots=True, eq=False)
class Preintegrated(Declared):
    """Measurements integrated between consecutive instants, in the IMU's axes at the first, without gravity.

    The error state is (rotation, velocity, position): R exp(phi), v + dv, p + dp.
    """

    seconds: Float64[np.ndarray, " m"]
    rotation: Float64[np.ndarray, "m 3 3"]
    velocity: Float64[np.ndarray, "m 3"]
    position: Float64[np.ndarray, "m 3"]
    covariance: Float64[np.ndarray, "m 9 9"]
    by_bias: Float64[np.ndarray, "m 9 6"]
    """Derivative by the biases (gyroscope, accelerometer)."""

    def __repr__(self) -> str:
        return f"Preintegrated({len(self.seconds)} intervals)"

    def at_biases(self, change: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(rotation, velocity, position) for biases changed by (m, 6), to first order (equation 44)."""
        moved = (self.by_bias @ change[..., None])[..., 0]
        rotated = self.rotation @ Rotation3.exp(moved[:, :3]).matrix
        return rotated, self.velocity + moved[:, 3:6], self.position + moved[:, 6:]


@checked
def preintegrate(
    log: ImuLog,
    instants_s: Float64[np.ndarray, " n"],
    gyro_bias: Float64[np.ndarray, " 3"] | None = None,
    accel_bias: Float64[np.ndarray, " 3"] | None = None,
    noise: ImuNoise | None = None,
) -> Preintegrated:
    """Integrate the measurements between consecutive instants (equations 33, 37 and A.9 to A.20).

    Samples are interpolated linearly (midpoint rule); covariance and derivatives are propagated along.

    Args:
        log: measurements.
        instants_s: n >= 2 increasing times, by the IMU's clock.
        gyro_bias: rad / s, subtracted; None: zero.
        accel_bias: m / s^2, subtracted; None: zero.
        noise: densities; None: the defaults.

    Raises:
        ShapeError: there are fewer than two instants, or they do not increase.
        DegenerateGeometryError: the log does not cover them, or has a gap.
    """
    if len(instants_s) < 2 or not (np.diff(instants_s) > 0).all():
        raise ShapeError("instants_s must have two or more increasing times")
    noise = ImuNoise() if noise is None else noise
    dt, gyro, accel = _steps(log, instants_s)
    zero = np.zeros(3)
    gyro = gyro - (zero if gyro_bias is None else gyro_bias)
    accel = accel - (zero if accel_bias is None else accel_bias)
    return _integrated(dt, gyro, accel, noise)


def _steps(log: ImuLog, instants_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps (m, s) and samples (m, s + 1, 3) of each interval, interpolated at its ends; padded with zero-length steps."""
    times = log.timestamp_s
    if not len(times) or instants_s[0] < times[0] or instants_s[-1] > times[-1]:
        raise DegenerateGeometryError("the IMU log does not cover the time of the trajectory")
    within = (times[1:] > instants_s[0]) & (times[:-1] < instants_s[-1])
    gap = float(np.diff(times)[within].max(initial=0.0))
    if gap > LARGEST_GAP_S:
        raise DegenerateGeometryError(
            f"the IMU log has a gap of {gap:.3g} s (at most {LARGEST_GAP_S:g} s is allowed)"
        )
    first = np.searchsorted(times, instants_s[:-1], side="right")
    last = np.searchsorted(times, instants_s[1:], side="left")
    count = int((last - first).max()) + 2
    own = first[:, None] + np.arange(count - 1)
    inner = np.where(
        own < last[:, None], times[np.minimum(own, len(times) - 1)], instants_s[1:, None]
    )  # past the last sample: repeat the end
    at = np.concatenate([instants_s[:-1, None], inner], axis=1)
    values = np.concatenate([log.gyro_rad_s, log.accel_m_s2], axis=1)
    sampled = np.stack([np.interp(at, times, values[:, k]) for k in range(6)], axis=-1)
    return np.diff(at, axis=1), sampled[..., :3], sampled[..., 3:]


def _integrated(dt: np.ndarray, gyro: np.ndarray, accel: np.ndarray, noise: ImuNoise) -> Preintegrated:
    """Integrate the intervals of `_steps`."""
    m = len(dt)
    out = np.empty((m, 3, 3)), np.empty((m, 3)), np.empty((m, 3)), np.empty((m, 9, 9)), np.empty((m, 9, 6))
    densities = np.array([noise.gyro_density**2, noise.accel_density**2])
    kernels.integrate(dt, gyro, accel, densities, out)
    return Preintegrated(dt.sum(axis=1), *out)
