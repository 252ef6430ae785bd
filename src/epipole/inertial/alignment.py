"""Scale, gravity, biases and velocities from an up-to-scale trajectory and an IMU."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse.linalg
from jaxtyping import Float64

from epipole._checks import Declared, checked
from epipole._damped import minimize
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial._inertial_problem import GRAVITY, InertialProblem, States
from epipole.inertial.dead_reckoning import ImuCalibration
from epipole.inertial.log import ImuLog, ImuNoise, MountedImu
from epipole.inertial.preintegration import Preintegrated, preintegrate

LEAST_POSES = 8
MOST_POSES = 200  # the variances need a dense inverse with 15 rows per pose
MOST_STEPS, CONVERGED = 30, 1e-6
LARGEST_SIGMA = 0.05
"""Largest accepted standard deviation of the log scale."""
OPEN = 0.5
"""Standard deviation of the log scale above which re-estimating the variances cannot help."""
LEAST_SIGMA = 1e-5
"""Lower bound for positions, as a fraction of the trajectory's extent, and for rotations in radians."""
METRIC_EXTENT = 1.0
"""Least extent of a trajectory in meters by which its errors are judged: at rest, gravity and gyroscope bias are observable, too."""
ROUNDS = 6
"""Rounds of estimating variances from the residuals."""
LARGEST_MISFIT = 30.0
"""Largest accepted misfit: above it, the IMU has another trajectory, clock or mounting."""


@dataclass(frozen=True, slots=True, eq=False)
class InertialAlignment(Declared):
    """Scale, gravity, biases and velocities of a trajectory with an IMU."""

    scale: float
    """Meters per unit of the trajectory; for a trajectory in meters the accelerometer's gain."""
    sigma: float
    """Standard deviation of the scale, including the accelerometer's gain error."""
    gravity_in_world: Float64[np.ndarray, " 3"]
    """m / s^2, in the trajectory's axes."""
    gyro_bias: Float64[np.ndarray, " 3"]
    """rad / s, mean over the trajectory."""
    accel_bias: Float64[np.ndarray, " 3"]
    """m / s^2, mean over the trajectory."""
    velocity_in_world: Float64[np.ndarray, "n 3"]
    """m / s, in the trajectory's axes, at each pose."""
    calibration: ImuCalibration
    """Scale, gravity, and the biases at the last pose, for dead reckoning from there."""
    path_sigma: tuple[float, float]
    """Standard deviations of a position coordinate, in the trajectory's unit, and of a rotation in radians, as given or estimated."""
    misfit: float
    """Square root of chi^2 per degree of freedom, with the stated sigmas (before they are re-estimated)."""

    def __repr__(self) -> str:
        return f"InertialAlignment(scale {self.scale:.6g} +- {self.sigma:.2g})"


@checked
def align_path_to_imu(
    timestamp_s: Float64[np.ndarray, " n"],
    world_from_camera: Rigid3,
    imu: MountedImu,
    position_sigma: float | None = None,
    rotation_sigma_rad: float = 2e-3,
    *,
    is_metric: bool = False,
) -> InertialAlignment:
    """Scale, gravity, biases and velocities by maximum a posteriori estimation.

    A linear start (Qin and Shen, Robust initialization of monocular visual-inertial estimation, IROS 2017), then
    Gauss-Newton over all states with the preintegrated measurements, the bias random walk and the trajectory's poses as
    terms (Campos, Montiel and Tardos, Inertial-only optimization for visual-inertial initialization, ICRA 2020, here with
    uncertain poses). Stated densities are those of an IMU at rest, but motors shake it: gyroscope, accelerometer, positions
    and rotations get the variances that their residuals show (variance components), never less than stated for the IMU.
    Gravity's length is unknown, too, since the accelerometer's gain multiplies it; without it, a gain error appears as tilt and biases.
    The scale's standard deviation comes from the inverse normal matrix. Motion at constant velocity leaves the scale
    undetermined, whatever the scene, and is rejected.

    Args:
        timestamp_s: increasing times of the poses by the IMU's clock, some tenths of a second apart.
        world_from_camera: the poses, up to scale.
        imu: measurements that cover them, mounting and noise.
        position_sigma: standard deviation of a position coordinate, in the trajectory's unit; None: estimated.
        rotation_sigma_rad: standard deviation of the rotations.
        is_metric: the trajectory is in meters. Then the scale is the accelerometer's gain, which gravity shows, too, and any
            motion, even rest, determines gravity and biases.

    Raises:
        DegenerateGeometryError: scale and gravity cannot be determined.
        ShapeError: array sizes do not match, a pose is not finite, or times do not increase.
        ConfigError: a sigma is not positive, or there are more than 200 poses.
    """
    log, camera_from_imu, noise = imu.log, imu.camera_from_imu, imu.noise
    _check(timestamp_s, world_from_camera, position_sigma, rotation_sigma_rad)
    _check_mounting(camera_from_imu)
    extent = float(np.ptp(world_from_camera.translation, axis=0).max())
    if is_metric:
        extent = max(extent, METRIC_EXTENT)
    if not extent > 0:
        raise DegenerateGeometryError("the camera does not move, so the IMU cannot determine the scale")
    sigmas = (1e-3 * extent if position_sigma is None else position_sigma, rotation_sigma_rad)
    gyro_bias = _gyro_bias(timestamp_s, world_from_camera, log, camera_from_imu, noise)
    measured = preintegrate(log, timestamp_s, gyro_bias, np.zeros(3), noise)
    states = _linear_start(measured, world_from_camera, camera_from_imu, gyro_bias, noise)
    if is_metric:
        lever = (world_from_camera.rotation @ camera_from_imu.translation[:, None])[..., 0]
        states = states._replace(log_scale=0.0, position=world_from_camera.translation + lever)
    problem = InertialProblem(
        measured, world_from_camera, camera_from_imu, noise, sigmas, gyro_bias, is_metric
    )
    try:
        states = _minimum(problem, states)
        stated = problem.misfit(states)
        if position_sigma is None:
            problem, states = _with_found_deviations(problem, states, extent, imu, timestamp_s)
        return _judged(problem, states, extent, stated)
    except np.linalg.LinAlgError as error:
        raise DegenerateGeometryError(f"no motion fits both the trajectory and the IMU ({error})") from error


def _with_found_deviations(
    problem: InertialProblem, states: States, extent: float, imu: MountedImu, times: np.ndarray
) -> tuple[InertialProblem, States]:
    """Re-estimate the sigmas from the residuals in a few rounds; returns the problem and its minimum."""
    stated, noise = imu.noise, imu.noise
    for _ in range(ROUNDS):
        if _sigma_of_log_scale(problem, states) > OPEN:
            break
        gyro, accel, position, rotation = np.sqrt(problem.variance_factors(states))
        noise = replace(
            noise,
            gyro_density=max(noise.gyro_density * gyro, stated.gyro_density),
            accel_density=max(noise.accel_density * accel, stated.accel_density),
        )
        sigmas = (
            max(problem.path_sigma[0] * position, LEAST_SIGMA * extent),
            max(problem.path_sigma[1] * rotation, LEAST_SIGMA),
        )
        measured = preintegrate(imu.log, times, problem.integrated_at, np.zeros(3), noise)
        problem = replace(problem, measured=measured, noise=noise, path_sigma=sigmas)
        states = _minimum(problem, states)
        if max(abs(np.log([gyro, accel, position, rotation]))) < 0.05:
            break
    return problem, states


def _check(times: np.ndarray, poses: Rigid3, position_sigma: float | None, rotation_sigma: float) -> None:
    if poses.batch_shape() != times.shape:
        raise ShapeError(f"timestamp_s has {len(times)} rows for {poses.batch_shape()} poses")
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise ShapeError("timestamp_s must be finite and increase")
    if not (np.isfinite(poses.rotation).all() and np.isfinite(poses.translation).all()):
        raise ShapeError("poses must be finite")
    if (position_sigma is not None and not 0 < position_sigma < np.inf) or not 0 < rotation_sigma < np.inf:
        raise ConfigError("position_sigma and rotation_sigma_rad must be positive and finite")
    if len(times) > MOST_POSES:
        raise ConfigError(
            f"{len(times)} poses are too many to align together (at most {MOST_POSES}): use fit_scale_to_imu, which splits longer trajectories"
        )
    if len(times) < LEAST_POSES:
        raise DegenerateGeometryError(
            f"{len(times)} poses are too few to align with an IMU, {LEAST_POSES} are needed"
        )


def _check_mounting(camera_from_imu: Rigid3) -> None:
    if not (np.isfinite(camera_from_imu.rotation).all() and np.isfinite(camera_from_imu.translation).all()):
        raise ShapeError("camera_from_imu must be finite")


def _gyro_bias(
    times: np.ndarray, poses: Rigid3, log: ImuLog, mounting: Rigid3, noise: ImuNoise
) -> np.ndarray:
    """Least squares over the rotations between poses, to first order, twice."""
    rotated = Rotation3(poses.rotation @ mounting.rotation)
    seen, bias = rotated[:-1].inverse() @ rotated[1:], np.zeros(3)
    for _ in range(2):
        measured = preintegrate(log, times, bias, np.zeros(3), noise)
        off = (Rotation3(measured.rotation).inverse() @ seen).log()
        by_bias = measured.by_bias[:, :3, :3].reshape(-1, 3)
        bias = bias + np.linalg.lstsq(by_bias, off.ravel(), rcond=None)[0]
    return bias


def _linear_start(
    measured: Preintegrated, poses: Rigid3, mounting: Rigid3, gyro_bias: np.ndarray, noise: ImuNoise
) -> States:
    """Linear least squares for velocities, scale, gravity and accelerometer bias."""
    n = len(poses.translation)
    rotated = poses.rotation @ mounting.rotation
    lever = (poses.rotation @ mounting.translation[:, None])[..., 0]  # from camera to IMU, in the world
    dt = measured.seconds
    columns = 3 * n + 7
    by_position, by_speed = np.zeros((n - 1, 3, columns)), np.zeros((n - 1, 3, columns))
    rows, axes = np.arange(n - 1)[:, None], np.arange(3)
    by_position[:, :, 3 * n] = np.diff(poses.translation, axis=0)
    by_position[rows, axes, 3 * rows + axes] = -dt[:, None]
    by_position[rows, axes, 3 * n + 1 + axes] = -0.5 * dt[:, None] ** 2
    by_position[:, :, 3 * n + 4 :] = -rotated[:-1] @ measured.by_bias[:, 6:, 3:]
    by_speed[rows, axes, 3 * rows + axes] = -1.0
    by_speed[rows, axes, 3 * rows + 3 + axes] = 1.0
    by_speed[rows, axes, 3 * n + 1 + axes] = -dt[:, None]
    by_speed[:, :, 3 * n + 4 :] = -rotated[:-1] @ measured.by_bias[:, 3:6, 3:]
    went = (rotated[:-1] @ measured.position[..., None])[..., 0] - np.diff(lever, axis=0)
    gained = (rotated[:-1] @ measured.velocity[..., None])[..., 0]
    prior = np.zeros((3, columns))
    prior[:, 3 * n + 4 :] = np.eye(3) * np.median(dt) ** 2 / noise.accel_bias_sigma / 10.0
    left = np.concatenate([by_position.reshape(-1, columns), by_speed.reshape(-1, columns), prior])
    right = np.concatenate([went.ravel(), gained.ravel(), np.zeros(3)])
    found = np.linalg.lstsq(left, right, rcond=None)[0]
    scale, gravity = abs(float(found[3 * n])), found[3 * n + 1 : 3 * n + 4]
    scale = max(scale, 1e-6)
    gravity = GRAVITY * gravity / max(float(np.linalg.norm(gravity)), 1e-9)
    biases = np.tile(np.concatenate([gyro_bias, np.zeros(3)]), (n, 1))
    positions = scale * poses.translation + lever
    return States(
        rotated, found[: 3 * n].reshape(-1, 3).copy(), positions, biases, float(np.log(scale)), gravity
    )


def _minimum(problem: InertialProblem, states: States) -> States:
    def step(states: States, equations: tuple[Any, np.ndarray], damping: float) -> States | None:
        normal, gradient = equations
        damped = normal + scipy.sparse.diags(damping * normal.diagonal() + 1e-12, format="csc")
        found = _solved(damped, gradient)
        return None if found is None else problem.moved(states, -found)

    return minimize(
        states,
        problem.cost,
        problem.normal_equations,
        step,
        damping=1e-6,
        tolerance=CONVERGED,
        max_steps=MOST_STEPS,
    )


def _sigma_of_log_scale(problem: InertialProblem, states: States) -> float:
    normal, _ = problem.normal_equations(states)
    unit = np.zeros(normal.shape[0])
    unit[problem.scale_column] = 1.0
    row = _solved(normal + 1e-12 * scipy.sparse.eye(len(unit), format="csc"), unit)
    variance = -1.0 if row is None else row[problem.scale_column]
    return float(np.sqrt(variance)) if variance >= 0 else np.inf


def _solved(matrix: scipy.sparse.csc_matrix, rhs: np.ndarray) -> np.ndarray | None:
    """Solution of a sparse linear system; None if the matrix is singular."""
    try:
        return _factored(matrix).solve(rhs)
    except RuntimeError:
        return None


def _factored(matrix: scipy.sparse.csc_matrix) -> Any:
    """Of a symmetric positive matrix whose blocks couple neighboring poses, and all of them scale and gravity, which come last.

    In this order there is no fill-in and no pivoting is needed; SuperLU's own order takes seven times as long.
    """
    return scipy.sparse.linalg.splu(
        matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def _judged(problem: InertialProblem, states: States, extent: float, stated: float) -> InertialAlignment:
    """The result, or an error if it is not credible."""
    scale = float(np.exp(states.log_scale))
    misfit = problem.misfit(states)
    sigma = _sigma_of_log_scale(problem, states) * max(misfit, 1.0)
    if not (np.isfinite(sigma) and sigma <= LARGEST_SIGMA):
        given = f"{100 * sigma:.0f} %" if np.isfinite(sigma) and sigma < 10 else "no accuracy at all"
        raise DegenerateGeometryError(
            f"the IMU determines the scale only to {given} ({100 * LARGEST_SIGMA:g} % is needed): motion at or near "
            "constant velocity looks the same at every scale, so move the camera back and forth"
        )
    position_sigma = problem.path_sigma[0]
    if position_sigma > 0.05 * extent or misfit > LARGEST_MISFIT:
        raise DegenerateGeometryError(
            "the IMU and the trajectory contradict each other: check clock, mounting and camera"
        )
    calibration = _calibration(problem, states, max(misfit, 1.0))
    return InertialAlignment(
        scale=scale,
        sigma=scale * float(np.hypot(sigma, 0.0 if problem.is_metric else problem.noise.accel_gain_sigma)),
        gravity_in_world=states.gravity * np.exp(-states.log_gain),
        gyro_bias=states.bias[:, :3].mean(axis=0),
        accel_bias=states.bias[:, 3:].mean(axis=0),
        velocity_in_world=states.velocity,
        calibration=calibration,
        path_sigma=problem.path_sigma,
        misfit=stated,
    )


def _calibration(problem: InertialProblem, states: States, factor: float) -> ImuCalibration:
    """What dead reckoning from the last pose needs, with standard deviations multiplied by a factor."""
    normal, _ = problem.normal_equations(states)
    last, size = problem.scale_column - 6, normal.shape[0]
    wanted = np.arange(last, last + 10)  # the last biases, scale and gravity
    unit = np.zeros((size, 10))
    unit[wanted, np.arange(10)] = 1.0
    inverse = _factored(normal + 1e-12 * scipy.sparse.eye(size, format="csc")).solve(unit)
    covariance = factor**2 * inverse[wanted]
    return ImuCalibration(
        float(np.exp(states.log_scale)),
        states.gravity,
        states.bias[-1, :3].copy(),
        states.bias[-1, 3:].copy(),
        0.5 * (covariance + covariance.T),
    )
