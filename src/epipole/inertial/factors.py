"""Inertial measurements as factors between the frames of a bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.linalg
from jaxtyping import Float64, Int64

from epipole._checks import checked
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, skew
from epipole.inertial import _imu_kernels as kernels
from epipole.inertial._inertial_problem import LANES, SHARED, InertialProblem, States
from epipole.inertial.alignment import InertialAlignment
from epipole.inertial.log import MountedImu
from epipole.inertial.preintegration import preintegrate

MOST_INNER_STEPS = (
    10  # the residuals are almost linear in the inner unknowns: velocities, biases, scale, gravity
)
CONVERGED = 1e-9
RIDGE = 1e-9
"""Fraction of its diagonal added to the inner matrix: unobservable unknowns keep their values."""
OUTER = 6  # unknowns of a pose
INNER = 9  # further unknowns of a frame: velocity and biases; those that all frames share come last


@dataclass(frozen=True, slots=True, eq=False)
class ImuFactors:
    """IMU cost of the frames of a trajectory, as a function of their poses alone.

    Velocities, biases, gravity and scale are minimized out for given poses (variable projection: Golub and Pereyra,
    SIAM J. Numer. Anal. 1973). An adjuster sees the cost min_y F(x, y), its gradient dF/dx, and the Schur complement of
    the inner unknowns as matrix.
    """

    frames: Int64[np.ndarray, " n"]
    """Rows of the adjusted frames, in order of time."""
    problem: InertialProblem
    start: States
    """Start of the search for the inner unknowns."""
    weight: float
    """Weight of the squares: the variance of a pixel, in an adjustment that assumes unit pixel variance."""
    _last: dict[bytes, tuple[float, np.ndarray, np.ndarray]] = field(default_factory=dict, repr=False)
    """Last result: an adjuster asks for a cost, and then for derivatives at the same poses."""
    _best: dict[bytes, tuple[States, float]] = field(default_factory=dict, repr=False)
    """Last optimum of the inner unknowns, from which the next search starts, unless the first start is better."""

    def __repr__(self) -> str:
        return f"ImuFactors({len(self.frames)} frames)"

    def linearized(
        self, rig_from_world: Rigid3
    ) -> tuple[float, Float64[np.ndarray, "n 6"], Float64[np.ndarray, "n 6 n 6"]]:
        """Half the weighted sum of squares at poses of `frames`, gradient and matrix by xi of exp(xi) @ rig_from_world.

        Raises:
            DegenerateGeometryError: the poses are not finite.
        """
        key = rig_from_world.rotation.tobytes() + rig_from_world.translation.tobytes()
        if key not in self._last:
            self._last.clear()
            self._last[key] = self._linearized(rig_from_world.inverse())
        return self._last[key]

    def _linearized(self, poses: Rigid3) -> tuple[float, np.ndarray, np.ndarray]:
        states, cost = self._at_best(poses)
        matrix, gradient = self._equations(states, poses)
        n = len(self.frames)
        out = matrix[: OUTER * n, : OUTER * n]
        across = matrix[OUTER * n :, : OUTER * n]
        out = out - across.T @ self._inner_solve(matrix, across)
        out = 0.5 * self.weight * (out + out.T).reshape(n, OUTER, n, OUTER)
        return self.weight * cost, self.weight * gradient[: OUTER * n].reshape(n, OUTER), out

    def scale(self, rig_from_world: Rigid3) -> tuple[float, float, Float64[np.ndarray, "n 6"]]:
        """Meters per unit of the trajectory, at the optimum for the given poses.

        Returns:
            the log scale; its variance if the poses are exact; its derivative by xi of exp(xi) @ rig_from_world.
        """
        poses = rig_from_world.inverse()
        states, _ = self._at_best(poses)
        matrix, _ = self._equations(states, poses)
        n = len(self.frames)
        unit = np.zeros(INNER * n + SHARED)
        unit[INNER * n] = 1.0
        row = self._inner_solve(matrix, unit)
        across = matrix[OUTER * n :, : OUTER * n]
        return states.log_scale, float(unit @ row), -(row @ across).reshape(n, OUTER)

    def gravity(self, rig_from_world: Rigid3) -> tuple[Float64[np.ndarray, " 3"], float]:
        """Gravity in the world, in m / s^2, at the optimum for the given poses, and the variance of its direction if they are exact."""
        poses = rig_from_world.inverse()
        states, _ = self._at_best(poses)
        matrix, _ = self._equations(states, poses)
        tilts = np.eye(len(matrix) - OUTER * len(self.frames))[:, -2:]
        variance = float((tilts * self._inner_solve(matrix, tilts)).sum())
        return states.gravity * np.exp(-states.log_gain), variance

    def variance_factors(self, rig_from_world: Rigid3) -> tuple[float, float]:
        """Factors by which to scale the stated variances of gyroscope and accelerometer, from adjusted poses.

        Of an interval's nine numbers each sensor has three degrees of freedom: three rotations, and six minus the three of a
        velocity. Poses that images constrain weakly adapt to the IMU, and show less.
        """
        states, _ = self._at_best(rig_from_world.inverse())
        squares = (self.problem.imu_terms(states, differentiate=False)[0].residual ** 2).sum(axis=0)
        freedom = 3.0 * (len(self.frames) - 1)
        return float(squares[:3].sum()) / freedom, float(squares[3:].sum()) / freedom

    def _at_best(self, poses: Rigid3) -> tuple[States, float]:
        """The inner unknowns that fit the poses best, by Gauss-Newton, and half the sum of squares."""
        key = poses.rotation.tobytes() + poses.translation.tobytes()
        if key not in self._best:
            starts = [self._localized(start, poses) for start, _ in (*self._best.values(), (self.start, 0.0))]
            self._best.clear()
            self._best[key] = self._searched(min(starts, key=self._cost), poses)
        return self._best[key]

    def _searched(self, states: States, poses: Rigid3) -> tuple[States, float]:
        n = len(self.frames)
        cost = self._cost(states)
        for _ in range(MOST_INNER_STEPS):
            matrix, gradient = self._equations(states, poses)
            step = -self._inner_solve(matrix, gradient[OUTER * n :])
            own, whole = step[: INNER * n].reshape(n, INNER), np.zeros((n, LANES))
            whole[:, 3:6], whole[:, 9:] = own[:, :3], own[:, 3:]
            moved = self.problem.moved(states, np.concatenate([whole.ravel(), step[INNER * n :]]))
            moved = self._localized(moved, poses)
            after = self._cost(moved)
            if not after < cost:
                break
            gain, states, cost = cost - after, moved, after
            if gain <= CONVERGED * cost:
                break
        return states, cost

    def _cost(self, states: States) -> float:
        terms = self.problem.imu_terms(states, differentiate=False)
        return 0.5 * sum(float((one.residual**2).sum()) for one in terms)

    def _localized(self, states: States, poses: Rigid3) -> States:
        """The states with IMU rotations and positions from the camera poses."""
        rotation, position = _of_unit(poses, self.problem.camera_from_imu, float(np.exp(states.log_scale)))
        return states._replace(rotation=rotation, position=position)

    def _equations(self, states: States, poses: Rigid3) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix and gradient over all poses, then velocities and biases, scale and gravity."""
        n, count = len(self.frames), self.problem.num_unknowns
        imu, walk, first, gains = self.problem.imu_terms(states)
        by_all = self._by_unknowns(imu.blocks, walk.blocks, states, poses)
        residual = np.concatenate([imu.residual, walk.residual], axis=1)
        frame = np.arange(n - 1)[:, None]
        own = [OUTER * (frame + e) + np.arange(OUTER) for e in (0, 1)]
        inner = [OUTER * n + INNER * (frame + e) + np.arange(INNER) for e in (0, 1)]
        shared = np.broadcast_to(np.arange(LANES * n, count), (n - 1, SHARED))
        at = np.concatenate([own[0], inner[0], own[1], inner[1], shared], axis=1)
        matrix, gradient = np.zeros((count, count)), np.zeros(count)
        kernels.add_normal_equations(at, by_all, residual, matrix, gradient)
        biases = OUTER * n + np.arange(3, INNER)
        by_first = first.blocks[0][1][0]
        matrix[np.ix_(biases, biases)] += by_first.T @ by_first
        gradient[biases] += by_first.T @ first.residual[0]
        by_gains, own_gains = gains.blocks[0][1][0], LANES * n + np.arange(2)
        matrix[np.ix_(own_gains, own_gains)] += by_gains.T @ by_gains
        gradient[own_gains] += by_gains.T @ gains.residual[0]
        return matrix, gradient

    def _by_unknowns(
        self,
        of_imu: list[tuple[np.ndarray, np.ndarray]],
        of_walk: list[tuple[np.ndarray, np.ndarray]],
        states: States,
        poses: Rigid3,
    ) -> np.ndarray:
        """(m, 15, 34) derivatives of an interval by both frames' xi, velocity and biases, and by what all frames share.

        Under xi = (rho, theta) the IMU rotates by -R_ci^T theta and moves by -s R_wc rho + R_wc [t_ci] theta.
        """
        m, imu = len(self.frames) - 1, self.problem.camera_from_imu
        scale = np.exp(states.log_scale)
        by_lane = np.zeros((2, m, LANES, LANES))
        by_lane[0, :, :9], by_lane[1, :, :9, :9] = of_imu[0][1], of_imu[1][1]
        by_lane[0, :, 9:, 9:], by_lane[1, :, 9:, 9:] = of_walk[0][1], of_walk[1][1]
        out = np.zeros((m, LANES, 2 * LANES + SHARED))
        for end in (0, 1):
            rotated, there = poses.rotation[end : m + end], poses.translation[end : m + end]
            by_rotation, by_position, first = by_lane[end, ..., :3], by_lane[end, ..., 6:9], LANES * end
            out[..., first : first + 3] = -scale * by_position @ rotated
            out[..., first + 3 : first + 6] = (
                by_position @ rotated @ skew(imu.translation) - by_rotation @ imu.rotation.T
            )
            out[..., first + 6 : first + 9] = by_lane[end, ..., 3:6]
            out[..., first + 9 : first + 15] = by_lane[end, ..., 9:]
            out[..., 2 * LANES] += scale * (by_position @ there[..., None])[..., 0]
        out[:, :9, 2 * LANES + 1 :] += of_imu[2][1]
        return out

    def _inner_solve(self, matrix: np.ndarray, rhs: np.ndarray) -> np.ndarray:
        """Solve with the Cholesky factor of the inner matrix, after scaling its columns."""
        inner = matrix[OUTER * len(self.frames) :, OUTER * len(self.frames) :]
        size = 1.0 / np.sqrt(np.maximum(inner.diagonal(), 1e-300))
        scaled = inner * size * size[:, None]
        scaled[np.diag_indices(len(scaled))] += RIDGE
        by_column = size.reshape(-1, *[1] * (rhs.ndim - 1))
        try:
            factor = scipy.linalg.cho_factor(scaled, lower=True, overwrite_a=True, check_finite=False)
        except np.linalg.LinAlgError:
            raise DegenerateGeometryError("the poses do not determine the motion of the IMU") from None
        return by_column * scipy.linalg.cho_solve(factor, by_column * rhs, check_finite=False)


@checked
def imu_factors(
    frames: Int64[np.ndarray, " n"],
    timestamp_s: Float64[np.ndarray, " n"],
    world_from_camera: Rigid3,
    imu: MountedImu,
    aligned: InertialAlignment,
    weight: float = 1.0,
    *,
    is_metric: bool = False,
) -> ImuFactors:
    """Factors between consecutive frames.

    Args:
        frames: their rows among all adjusted frames.
        timestamp_s: increasing, by the IMU's clock.
        world_from_camera: approximate poses.
        imu: measurements that cover them.
        aligned: initial scale, gravity and biases.
        weight: of the squares; the variance of a pixel, in an adjustment that assumes unit pixel variance.
        is_metric: as for `align_path_to_imu`.

    Raises:
        ShapeError: array sizes do not match, or times do not increase.
        DegenerateGeometryError: the log does not cover the times, or has a gap.
    """
    n = len(frames)
    if len(timestamp_s) != n or world_from_camera.batch_shape() != (n,):
        raise ShapeError(f"timestamp_s and world_from_camera must have {n} rows, as frames has")
    measured = preintegrate(imu.log, timestamp_s, aligned.gyro_bias, np.zeros(3), imu.noise)
    sigmas = (1.0, 1.0)  # of the poses, which are given
    problem = InertialProblem(
        measured, world_from_camera, imu.camera_from_imu, imu.noise, sigmas, aligned.gyro_bias, is_metric
    )
    scale, gravity = aligned.calibration.scale, aligned.calibration.gravity_in_world
    rotation, positions = _of_unit(world_from_camera, imu.camera_from_imu, scale)
    velocity = np.gradient(positions, timestamp_s, axis=0)
    biases = np.tile(np.concatenate([aligned.gyro_bias, aligned.accel_bias]), (n, 1))
    start = States(rotation, velocity, positions, biases, float(np.log(scale)), gravity)
    return ImuFactors(frames, problem, start, weight)


def _of_unit(poses: Rigid3, mounting: Rigid3, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and positions of the IMU, in meters, from camera poses."""
    lever = (poses.rotation @ mounting.translation[:, None])[..., 0]
    return poses.rotation @ mounting.rotation, scale * poses.translation + lever
