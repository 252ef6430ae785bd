"""Clock offset and rotation between a camera and an IMU, from their rotations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole._checks import Declared, checked
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial.log import ImuLog, MountedImu

APART_S = 0.15
"""Least time between poses: rotations over shorter times contain more noise than motion."""
LONGEST_S = 1.0
LEAST_PAIRS = 8
STEP_S = 0.01
"""Step of the search."""
DERIVATIVE_S = 1e-3
LARGEST_SIGMA_S = 5e-3
LARGEST_SIGMA_RAD = 0.02
"""Larger standard deviations mean that the motion does not show the offset or the rotation."""
LARGEST_MISFIT_RAD = 0.03
"""Largest scatter of the rotations about the fit."""
MOST_STEPS, CONVERGED = 10, 1e-7
REACH = 4.0
"""Rotations that differ by more of their median deviations are ignored as outliers."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuClock(Declared):
    """Estimated clock offset, and rotation of the mounting."""

    offset_s: float
    """The IMU's time minus the camera's."""
    offset_sigma_s: float
    rotation: Float64[np.ndarray, "3 3"]
    """Of camera_from_imu."""
    rotation_covariance: Float64[np.ndarray, "3 3"]
    """Of phi in exp(phi) @ rotation, in square radians."""
    gyro_bias: Float64[np.ndarray, " 3"]
    """rad / s."""
    num_rotations: int
    """Number of rotations that agree."""

    def __repr__(self) -> str:
        return f"ImuClock(offset {self.offset_s:.4f} +- {self.offset_sigma_s:.4f} s)"


@checked
def fit_imu_clock(
    timestamp_s: Float64[np.ndarray, " n"],
    world_from_camera: Rigid3,
    imu: MountedImu,
    largest_offset_s: float = 0.3,
) -> ImuClock:
    """The clock offset and rotation of the mounting that explain the camera's rotations by the gyroscope's.

    Between two poses the camera rotates by R_ci G R_ci^T, where G integrates the gyroscope over the same time plus the offset
    (the same relation as in Kelly and Sukhatme, IJRR 2014). A search over the offset starts a least-squares estimate of
    offset, rotation and gyroscope bias. Positions are not used, so that a trajectory up to scale suffices. The errors of all
    rotations count as independent, as those of a drifting camera are; with independent errors of poses the standard
    deviations are up to twice too large.

    Args:
        timestamp_s: increasing times of the poses, by the camera's clock.
        world_from_camera: the poses; only their rotations are used.
        imu: measurements and approximate mounting (within some ten degrees).
        largest_offset_s: largest possible offset, in seconds.

    Raises:
        ShapeError: array sizes do not match, a pose is not finite, or times do not increase.
        ConfigError: largest_offset_s is out of range.
        DegenerateGeometryError: the log does not cover the trajectory, the rotations contradict each other, or they do not
            show the offset, such as rest, or rotation at constant speed.
    """
    _check(timestamp_s, world_from_camera, largest_offset_s)
    gyro = _IntegratedGyro(imu.log)
    rows = _pairs(timestamp_s, gyro, largest_offset_s)
    if len(rows) < LEAST_PAIRS:
        raise DegenerateGeometryError(
            f"the IMU log covers {len(rows)} rotations of the camera, {LEAST_PAIRS} are needed to find its clock offset"
        )
    times = timestamp_s[rows]
    rotations = Rotation3(world_from_camera.rotation)
    seen = rotations[rows[:, 0]].inverse() @ rotations[rows[:, 1]]
    offsets = np.arange(-largest_offset_s, largest_offset_s + 0.5 * STEP_S, STEP_S)
    mount = Rotation3(imu.camera_from_imu.rotation)
    costs = [float(np.median(np.linalg.norm(_off(gyro, times, d, mount, seen), axis=1))) for d in offsets]
    return _fit(gyro, times, seen, mount, float(offsets[np.argmin(costs)]), largest_offset_s)


def _check(times: np.ndarray, poses: Rigid3, largest_offset_s: float) -> None:
    if poses.batch_shape() != times.shape:
        raise ShapeError(f"timestamp_s has {len(times)} rows for {poses.batch_shape()} poses")
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise ShapeError("timestamp_s must be finite and increase")
    if not np.isfinite(poses.rotation).all():
        raise ShapeError("poses must be finite")
    if not 0 < largest_offset_s <= 10:
        raise ConfigError(f"largest_offset_s must be positive and at most 10, got {largest_offset_s}")


class _IntegratedGyro:
    """Rotations of the IMU since the start of its log, at any time."""

    def __init__(self, log: ImuLog) -> None:
        self.times, self.rates = log.timestamp_s, log.gyro_rad_s
        mean = 0.5 * (self.rates[1:] + self.rates[:-1])
        steps = Rotation3.exp(mean * np.diff(self.times)[:, None]).matrix
        since = np.tile(np.eye(3), (max(len(self.times), 1), 1, 1))
        for k, step in enumerate(steps):
            since[k + 1] = since[k] @ step
        self.since = since

    def between(self, start_s: np.ndarray, stop_s: np.ndarray) -> Rotation3:
        """(n,) rotations between two times each, in the IMU's axes at the first."""
        return Rotation3(np.swapaxes(self._at(start_s), 1, 2) @ self._at(stop_s))

    def _at(self, times: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        span = (times - self.times[k])[:, None]
        slope = (self.rates[k + 1] - self.rates[k]) / (self.times[k + 1] - self.times[k])[:, None]
        return self.since[k] @ Rotation3.exp(self.rates[k] * span + 0.5 * slope * span**2).matrix


def _pairs(times: np.ndarray, gyro: _IntegratedGyro, margin_s: float) -> np.ndarray:
    """(m, 2) rows of poses APART_S or more apart, each pair beginning where the last one ended, within the log."""
    out, start = [], None
    if len(gyro.times) < 2:
        return np.zeros((0, 2), np.int64)
    first, last = gyro.times[0] + margin_s, gyro.times[-1] - margin_s
    for row in np.flatnonzero((times >= first) & (times <= last)).tolist():
        if start is not None and times[row] - times[start] < APART_S:
            continue
        if start is not None and times[row] - times[start] <= LONGEST_S:
            out.append((start, row))
        start = row
    return np.array(out, np.int64).reshape(-1, 2)


def _off(
    gyro: _IntegratedGyro, times: np.ndarray, offset_s: float, mount: Rotation3, seen: Rotation3
) -> np.ndarray:
    """(m, 3) rotation vectors, in camera axes, from the gyroscope's rotations to the camera's."""
    measured = gyro.between(times[:, 0] + offset_s, times[:, 1] + offset_s)
    by_imu = Rotation3(mount.matrix @ measured.matrix @ mount.matrix.T)
    return (by_imu.inverse() @ seen).log()


def _fit(
    gyro: _IntegratedGyro,
    times: np.ndarray,
    seen: Rotation3,
    mount: Rotation3,
    offset: float,
    largest_offset_s: float,
) -> ImuClock:
    """Gauss-Newton over offset, rotation and bias, with outliers removed by the scatter of each step."""
    bias, span = np.zeros(3), np.diff(times, axis=1)
    for _ in range(MOST_STEPS):
        off = _off(gyro, times, offset, mount, seen) + span * (mount.matrix @ bias)
        by_all = _derivatives(gyro, times, offset, mount, seen)
        size = np.linalg.norm(off, axis=1)
        good = size <= REACH * np.median(size) + 1e-12
        jacobian, residual = by_all[good].reshape(-1, 7), off[good].ravel()
        step = -np.linalg.lstsq(jacobian, residual, rcond=None)[0]
        offset, bias = offset + step[0], bias + step[4:]
        mount = Rotation3(Rotation3.exp(step[1:4]).matrix @ mount.matrix)
        if abs(offset) > largest_offset_s:
            raise DegenerateGeometryError("no clock offset explains the camera's rotations by the IMU's")
        if np.abs(step).max() < CONVERGED:
            break
    return _judged(jacobian, residual, offset, mount, bias)


def _derivatives(
    gyro: _IntegratedGyro, times: np.ndarray, offset: float, mount: Rotation3, seen: Rotation3
) -> np.ndarray:
    """(m, 3, 7) of the rotation vectors by offset, rotation of the mounting and bias, to first order in short rotations."""
    ahead, behind = (_off(gyro, times, offset + h, mount, seen) for h in (DERIVATIVE_S, -DERIVATIVE_S))
    out = np.zeros((len(times), 3, 7))
    out[:, :, 0] = (ahead - behind) / (2.0 * DERIVATIVE_S)
    # exp(phi) G exp(-phi) = G exp((G^-1 - 1) phi) to first order, in camera axes.
    measured = gyro.between(times[:, 0] + offset, times[:, 1] + offset).matrix
    by_imu = mount.matrix @ measured @ mount.matrix.T
    out[:, :, 1:4] = np.eye(3) - np.swapaxes(by_imu, 1, 2)
    out[:, :, 4:] = np.diff(times, axis=1)[:, :, None] * mount.matrix
    return out


def _judged(
    jacobian: np.ndarray, residual: np.ndarray, offset: float, mount: Rotation3, bias: np.ndarray
) -> ImuClock:
    """The result, or an error if the rotations contradict each other or do not show it."""
    freedom = len(residual) - 7
    sigma = float(np.sqrt((residual**2).sum() / freedom)) if freedom > 0 else np.inf
    if not sigma <= LARGEST_MISFIT_RAD:
        raise DegenerateGeometryError(
            f"the camera's rotations differ from the IMU's by {np.degrees(sigma):.2g} degrees at any clock offset: check mounting and log"
        )
    normal = jacobian.T @ jacobian
    size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    inverse = np.linalg.pinv(normal / size / size[:, None], rcond=1e-12) / size / size[:, None]
    # A direction without information has no pseudo-inverse, but an infinite variance.
    covariance = sigma**2 * inverse
    known = np.linalg.eigvalsh(normal / size / size[:, None])[0] > 1e-9
    offset_sigma = float(np.sqrt(covariance[0, 0])) if known else np.inf
    rotation_sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[1:4, 1:4])[-1])) if known else np.inf
    if not (offset_sigma <= LARGEST_SIGMA_S and rotation_sigma <= LARGEST_SIGMA_RAD):
        raise DegenerateGeometryError(
            "the motion does not show the IMU's clock offset and rotation: rotate the camera back and forth about different axes"
        )
    return ImuClock(offset, offset_sigma, mount.matrix, covariance[1:4, 1:4].copy(), bias, len(residual) // 3)
