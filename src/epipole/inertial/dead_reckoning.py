"""Dead reckoning: the motion of a camera by an IMU alone, from its last known poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole._checks import Declared, checked
from epipole.errors import ShapeError
from epipole.geometry import Rigid3, Rotation3, skew
from epipole.inertial._inertial_problem import across_gravity
from epipole.inertial.log import MountedImu
from epipole.inertial.preintegration import Preintegrated, preintegrate

LEAST_SIGMA_M = 1e-4
"""Lower bound for the positions' standard deviation, which few poses underestimate."""
_ROTATION, _VELOCITY, _POSITION, _CALIBRATION = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 19)
_BIAS, _SCALE, _GRAVITY = slice(9, 15), 15, slice(16, 19)


@dataclass(frozen=True, slots=True, eq=False)
class ImuCalibration(Declared):
    """What is needed to convert measurements to motion in the world of a map."""

    scale: float
    """The IMU's meters per unit of the map, which include its accelerometer's gain along the motion."""
    gravity_in_world: Float64[np.ndarray, " 3"]
    """The IMU's m / s^2."""
    gyro_bias: Float64[np.ndarray, " 3"]
    """rad / s."""
    accel_bias: Float64[np.ndarray, " 3"]
    """m / s^2."""
    covariance: Float64[np.ndarray, "10 10"]
    """Of both biases, of the log scale, of the log gain along gravity, and of gravity's rotation about two axes perpendicular to it, in
    radians."""

    def gravity_by_calibration(self) -> Float64[np.ndarray, "3 3"]:
        """Derivative of gravity by the log gain and its rotation."""
        gravity = self.gravity_in_world
        return np.concatenate([gravity[:, None], -skew(gravity) @ across_gravity(gravity)], axis=1)

    def __repr__(self) -> str:
        return f"ImuCalibration(scale {self.scale:.6g})"


@dataclass(frozen=True, slots=True, eq=False)
class ImuMotion(Declared):
    """Pose and velocity of an IMU at one time."""

    timestamp_s: float
    world_from_imu: Rigid3
    """In meters."""
    velocity_in_world: Float64[np.ndarray, " 3"]
    """m / s."""
    covariance: Float64[np.ndarray, "19 19"]
    """Of phi in R exp(phi), of velocity and position in the world, and of the calibration (as `ImuCalibration.covariance`)."""
    calibration: ImuCalibration

    def cam_from_world(self, camera_from_imu: Rigid3) -> tuple[Rigid3, Float64[np.ndarray, "6 6"]]:
        """Pose of a camera in the unit of the map, and the covariance of xi = (translation, rotation) in exp(xi) @ the pose."""
        scale, rotation = self.calibration.scale, self.world_from_imu.rotation
        pose = camera_from_imu @ self.world_from_imu.inverse()
        # (R exp(phi), p + dp) has the inverse exp(xi) @ imu_from_world with xi = (-R^T dp, -phi).
        by_state = np.zeros((6, 19))
        by_state[:3, _POSITION], by_state[3:, _ROTATION] = -rotation.T, -np.eye(3)
        by_state = np.diag(np.repeat([1.0 / scale, 1.0], 3)) @ camera_from_imu.adjoint() @ by_state
        by_state[:3, _SCALE] = -pose.translation / scale
        scaled = Rigid3(pose.rotation, pose.translation / scale)
        return scaled, by_state @ self.covariance @ by_state.T


@checked
def fit_imu_motion(
    timestamp_s: Float64[np.ndarray, " n"],
    world_from_camera: Rigid3,
    covariance: Float64[np.ndarray, "6 6"],
    imu: MountedImu,
    calibration: ImuCalibration,
) -> ImuMotion:
    """The motion at the last of some poses, by linear least squares.

    Without what gravity and accelerometer add, the IMU moves at constant velocity: a straight line fits its positions. The
    scatter about the line gives the standard deviation of the positions.

    Args:
        timestamp_s: n >= 3 increasing times, within about a second.
        world_from_camera: poses, in the unit of the map.
        covariance: of xi in exp(xi) @ the last cam_from_world, in the unit of the map; its rotation part is used.
        imu: measurements, mounting and noise.
        calibration: scale, gravity and biases.

    Raises:
        ShapeError: there are fewer than three poses, array sizes do not match, or times do not increase.
        DegenerateGeometryError: the log does not cover the times, or has a gap.
    """
    n = len(timestamp_s)
    if n < 3 or world_from_camera.batch_shape() != (n,):
        raise ShapeError(
            f"three times with one pose each are needed, got {n} times for {world_from_camera.batch_shape()} poses"
        )
    measured = preintegrate(imu.log, timestamp_s, calibration.gyro_bias, calibration.accel_bias, imu.noise)
    rotation = world_from_camera.rotation @ imu.camera_from_imu.rotation
    lever = (world_from_camera.rotation @ imu.camera_from_imu.translation[:, None])[..., 0]
    positions = calibration.scale * world_from_camera.translation + lever
    gained, went, gained_by, went_by = _added(measured, rotation, calibration)
    at = timestamp_s - timestamp_s[-1]
    line = np.stack([np.ones(n), at], axis=1)
    fit = np.linalg.pinv(line)  # of (position, velocity at the last time, less what was added)
    found = fit @ (positions - went)
    scatter = positions - went - line @ found
    sigma = max(np.sqrt((scatter**2).sum() / (3.0 * (n - 2))), LEAST_SIGMA_M)
    own = sigma**2 * fit @ fit.T
    positions_by = -went_by
    positions_by[:, :, 6] += calibration.scale * world_from_camera.translation
    by_calibration = np.zeros((19, 10))
    by_calibration[_POSITION] = went_by[-1] + np.einsum("n,nij->ij", fit[0], positions_by)
    by_calibration[_VELOCITY] = gained_by[-1] + np.einsum("n,nij->ij", fit[1], positions_by)
    by_calibration[_CALIBRATION] = np.eye(10)
    whole = by_calibration @ calibration.covariance @ by_calibration.T
    mount = imu.camera_from_imu.rotation
    whole[_ROTATION, _ROTATION] += mount.T @ covariance[3:, 3:] @ mount
    for rows, a in ((_POSITION, 0), (_VELOCITY, 1)):
        for columns, b in ((_POSITION, 0), (_VELOCITY, 1)):
            whole[rows, columns] += own[a, b] * np.eye(3)
    pose = Rigid3(rotation[-1].copy(), found[0] + went[-1])
    return ImuMotion(float(timestamp_s[-1]), pose, found[1] + gained[-1], whole, calibration)


def _added(
    measured: Preintegrated, rotation: np.ndarray, calibration: ImuCalibration
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Velocity and position (n, 3) that gravity and accelerometer add since the first time; derivatives (n, 3, 10) by the calibration."""
    n, gravity = len(rotation), calibration.gravity_in_world
    gravity_by = calibration.gravity_by_calibration()
    gained, went = np.zeros((n, 3)), np.zeros((n, 3))
    gained_by, went_by = np.zeros((n, 3, 10)), np.zeros((n, 3, 10))
    for i, dt in enumerate(measured.seconds):
        there = rotation[i]
        went[i + 1] = went[i] + gained[i] * dt + 0.5 * gravity * dt**2 + there @ measured.position[i]
        gained[i + 1] = gained[i] + gravity * dt + there @ measured.velocity[i]
        went_by[i + 1] = went_by[i] + gained_by[i] * dt
        went_by[i + 1, :, :6] += there @ measured.by_bias[i, 6:]
        went_by[i + 1, :, 7:] += 0.5 * gravity_by * dt**2
        gained_by[i + 1] = gained_by[i]
        gained_by[i + 1, :, :6] += there @ measured.by_bias[i, 3:6]
        gained_by[i + 1, :, 7:] += gravity_by * dt
    return gained, went, gained_by, went_by


@checked
def carry_motion(motion: ImuMotion, timestamp_s: float, imu: MountedImu) -> ImuMotion:
    """The motion at a later time, by integration (Forster et al. 2017, equation 26), with its covariance.

    Args:
        motion: the motion before.
        timestamp_s: later time.
        imu: measurements and noise.

    Raises:
        ShapeError: the time is not later.
        DegenerateGeometryError: the log does not cover the time between, or has a gap.
    """
    known, start = motion.calibration, motion.world_from_imu
    span = np.array([motion.timestamp_s, timestamp_s])
    measured = preintegrate(imu.log, span, known.gyro_bias, known.accel_bias, imu.noise)
    dt, gravity, rotation = float(measured.seconds[0]), known.gravity_in_world, start.rotation
    by_bias, rotated = measured.by_bias[0], measured.rotation[0]
    velocity = motion.velocity_in_world + gravity * dt + rotation @ measured.velocity[0]
    position = start.translation + motion.velocity_in_world * dt + 0.5 * gravity * dt**2
    position = position + rotation @ measured.position[0]
    change = np.eye(19)
    change[_ROTATION, _ROTATION] = rotated.T
    change[_VELOCITY, _ROTATION] = -rotation @ skew(measured.velocity[0])
    change[_POSITION, _ROTATION] = -rotation @ skew(measured.position[0])
    change[_POSITION, _VELOCITY] = dt * np.eye(3)
    gravity_by = known.gravity_by_calibration()
    change[_VELOCITY, _GRAVITY], change[_POSITION, _GRAVITY] = dt * gravity_by, 0.5 * dt**2 * gravity_by
    to_world = np.eye(9)
    to_world[3:6, 3:6] = to_world[6:, 6:] = rotation
    change[:9, _BIAS] = to_world @ by_bias
    covariance = change @ motion.covariance @ change.T
    covariance[:9, :9] += to_world @ measured.covariance[0] @ to_world.T
    walked = dt * np.repeat([imu.noise.gyro_walk**2, imu.noise.accel_walk**2], 3)
    covariance[_BIAS, _BIAS] += np.diag(walked)
    pose = Rigid3(Rotation3(rotation @ rotated).matrix, position)
    return ImuMotion(timestamp_s, pose, velocity, covariance, known)
