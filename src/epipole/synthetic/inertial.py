"""Trajectories with simulated IMU measurements and ground truth."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from epipole._checks import checked
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial import ImuLog, ImuNoise, MountedImu

RATE_HZ, STEP_S = 200.0, 1e-4
GRAVITY = 9.81


@dataclass(frozen=True, slots=True, eq=False)
class InertialPath:
    """Poses up to scale, IMU measurements, and the true values to estimate."""

    timestamp_s: Float64[np.ndarray, " n"]
    world_from_camera: Rigid3
    """Noisy poses, up to scale."""
    log: ImuLog
    camera_from_imu: Rigid3
    scale: float
    """Meters per unit of the poses."""
    gravity_in_world: Float64[np.ndarray, " 3"]
    velocity_in_world: Float64[np.ndarray, "n 3"]
    """Of the IMU, in m / s."""
    gyro_bias: Float64[np.ndarray, " 3"]
    """Mean over the trajectory."""
    accel_bias: Float64[np.ndarray, " 3"]
    noise: ImuNoise = field(default_factory=ImuNoise)

    def imu(self) -> MountedImu:
        """The IMU on the camera."""
        return MountedImu(self.log, self.camera_from_imu, self.noise)


@checked
def inertial_path(
    seed: int,
    seconds: float = 15.0,
    position_sigma_m: float = 2e-3,
    rotation_sigma_rad: float = 2e-3,
    *,
    constant_velocity: bool = False,
    noise: ImuNoise | None = None,
) -> InertialPath:
    """A hand-held IMU: sinusoidal positions and rotations, random gravity direction, random-walk biases, and a small gain error.

    Args:
        seed: random seed.
        seconds: duration, at least 2.
        position_sigma_m: noise of the positions, in meters.
        rotation_sigma_rad: noise of the rotations, in radians.
        constant_velocity: move at constant velocity instead; the rotation is unchanged.
        noise: of the IMU; None: the defaults.

    Raises:
        ConfigError: the duration or a noise is out of range.
    """
    if not 2 <= seconds < 1e4 or not (0 <= position_sigma_m < 1 and 0 <= rotation_sigma_rad < 1):
        raise ConfigError("seconds must be at least 2, and noise at least 0 and below 1")
    noise = ImuNoise() if noise is None else noise
    rng = np.random.default_rng([17, seed])
    motion = _Motion(rng, is_even=constant_velocity)
    times = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    up = rng.normal(size=3)
    gravity = -GRAVITY * up / np.linalg.norm(up)
    rotating, force = motion.measured(times, gravity)
    log, gyro_bias, accel_bias = _noisy(rng, times, rotating, force, noise)
    instants = np.arange(0.2, seconds - 0.2, 0.25)
    mounting = Rigid3(Rotation3.exp(rng.normal(size=3)).matrix, 0.05 * rng.normal(size=3))
    cameras = motion.position(instants) @ mounting.inverse()
    scale = float(np.exp(rng.uniform(-1.0, 1.0)))
    rotations = Rotation3.exp(rotation_sigma_rad * rng.normal(size=(len(instants), 3))).matrix
    positions = (cameras.translation + position_sigma_m * rng.normal(size=(len(instants), 3))) / scale
    return InertialPath(
        instants,
        Rigid3(cameras.rotation @ rotations, positions),
        log,
        mounting,
        scale,
        gravity,
        motion.velocity(instants),
        gyro_bias.mean(axis=0),
        accel_bias.mean(axis=0),
        noise,
    )


@checked
def imu_along(
    timestamp_s: Float64[np.ndarray, " n"],
    world_from_camera: Rigid3,
    camera_from_imu: Rigid3,
    seed: int,
    noise: ImuNoise | None = None,
    gravity_in_world: tuple[float, float, float] = (0.0, 0.0, -GRAVITY),
) -> ImuLog:
    """Measurements of an IMU mounted on a camera that moves along splines through given poses.

    Arguments and errors are those of `imu_and_biases_along`.
    """
    return imu_and_biases_along(
        timestamp_s, world_from_camera, camera_from_imu, seed, noise, gravity_in_world
    )[0]


@checked
def imu_and_biases_along(
    timestamp_s: Float64[np.ndarray, " n"],
    world_from_camera: Rigid3,
    camera_from_imu: Rigid3,
    seed: int,
    noise: ImuNoise | None = None,
    gravity_in_world: tuple[float, float, float] = (0.0, 0.0, -GRAVITY),
) -> tuple[ImuLog, Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3"]]:
    """The same with the true biases of gyroscope and accelerometer at each measurement.

    Args:
        timestamp_s: increasing times of the poses.
        world_from_camera: the poses, in meters.
        camera_from_imu: mounting of the IMU.
        seed: random seed of noise, biases and gain.
        noise: of the IMU; None: the defaults.
        gravity_in_world: in m / s^2.

    Raises:
        ShapeError: there are fewer than four poses, or times do not increase.
    """
    if len(timestamp_s) < 4 or world_from_camera.batch_shape() != timestamp_s.shape:
        raise ShapeError(f"at least four times with one pose each are needed, got {len(timestamp_s)} times")
    if not (np.diff(timestamp_s) > 0).all():
        raise ShapeError("timestamp_s must increase")
    noise = ImuNoise() if noise is None else noise
    unit = world_from_camera @ camera_from_imu
    times = np.arange(timestamp_s[0], timestamp_s[-1], 1.0 / RATE_HZ)
    rotations = RotationSpline(timestamp_s, Rotation.from_matrix(unit.rotation))
    swing = CubicSpline(timestamp_s, unit.translation)(times, 2)
    back = np.swapaxes(rotations(times).as_matrix(), 1, 2)
    force = (back @ (swing - np.array(gravity_in_world))[..., None])[..., 0]
    return _noisy(np.random.default_rng([18, seed]), times, rotations(times, 1), force, noise)


def _noisy(
    rng: np.random.Generator, times: np.ndarray, rotating: np.ndarray, force: np.ndarray, noise: ImuNoise
) -> tuple[ImuLog, np.ndarray, np.ndarray]:
    """Measurements with a gain error, random-walk biases and white noise; and the biases of gyroscope and accelerometer."""
    gain = 1.0 + noise.accel_gain_sigma * rng.normal()
    gyro_bias = _walk(rng, 0.02, noise.gyro_walk, len(times))
    accel_bias = _walk(rng, 0.1, noise.accel_walk, len(times))
    white = rng.normal(size=(2, len(times), 3)) * np.sqrt(RATE_HZ)
    gyro = rotating + gyro_bias + noise.gyro_density * white[0]
    accel = gain * force + accel_bias + noise.accel_density * white[1]
    return ImuLog(times, gyro, accel), gyro_bias, accel_bias


def _walk(rng: np.random.Generator, size: float, density: float, count: int) -> np.ndarray:
    steps = density * rng.normal(size=(count, 3)) / np.sqrt(RATE_HZ)
    return size * rng.normal(size=3) + np.cumsum(steps, axis=0)


class _Motion:
    """A smooth motion and its derivatives."""

    def __init__(self, rng: np.random.Generator, *, is_even: bool) -> None:
        self._size = np.zeros(3) if is_even else rng.uniform(0.3, 0.8, 3)
        self._rate, self._phase = rng.uniform(1.0, 2.5, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
        self._speed = rng.normal(size=3) * (1.0 if is_even else 0.1)
        self._rotate, self._rotation_rate = rng.uniform(0.2, 0.4, 3), rng.uniform(0.5, 1.2, 3)

    def position(self, times: np.ndarray) -> Rigid3:
        t = times[:, None]
        at = self._size * np.sin(self._rate * t + self._phase) + self._speed * t
        return Rigid3(Rotation3.exp(self._rotate * np.sin(self._rotation_rate * t + self._phase)).matrix, at)

    def velocity(self, times: np.ndarray) -> np.ndarray:
        t = times[:, None]
        return self._size * self._rate * np.cos(self._rate * t + self._phase) + self._speed

    def measured(self, times: np.ndarray, gravity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angular velocity and specific force R^T (a - g)."""
        before, after = self.position(times - STEP_S), self.position(times + STEP_S)
        rotating = (Rotation3(before.rotation).inverse() @ Rotation3(after.rotation)).log() / (2 * STEP_S)
        swing = -self._size * self._rate**2 * np.sin(self._rate * times[:, None] + self._phase)
        back = np.swapaxes(self.position(times).rotation, 1, 2)
        return rotating, (back @ (swing - gravity)[..., None])[..., 0]
