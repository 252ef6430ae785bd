"""Least squares over poses, velocities, biases, gravity and one scale: terms, derivatives, normal equations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy.linalg.lapack
import scipy.sparse

from epipole.geometry import Rigid3, Rotation3, skew
from epipole.geometry.tangents import inverse_right_jacobian
from epipole.inertial import _imu_kernels as kernels
from epipole.inertial.log import ImuNoise
from epipole.inertial.preintegration import Preintegrated

LANES = 15
"""Unknowns per pose: rotation, velocity, position, gyroscope bias, accelerometer bias."""
SHARED = 4
"""Unknowns that all poses share: scale, and gravity's length and direction."""
GRAVITY = 9.81
"""m / s^2; from the equator to the poles it varies by 0.5 %, less than an accelerometer's gain."""


class States(NamedTuple):
    """States of the IMU, in world axes, and meters as its accelerometer measures them: multiplied by its gain along the motion."""

    rotation: np.ndarray  # (n, 3, 3) world_from_imu
    velocity: np.ndarray  # (n, 3)
    position: np.ndarray  # (n, 3)
    bias: np.ndarray  # (n, 6)
    log_scale: float  # meters of the IMU per unit of the trajectory
    gravity: np.ndarray  # (3,), of length GRAVITY times the gain along it

    @property
    def log_gain(self) -> float:
        """Logarithm of the accelerometer's gain along gravity, which rotations separate from the biases."""
        return float(np.log(np.linalg.norm(self.gravity) / GRAVITY))


class Terms(NamedTuple):
    """Whitened residuals (m, r), and Jacobian blocks (m, r, c) with the first column of each."""

    residual: np.ndarray
    blocks: list[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, slots=True, eq=False)
class InertialProblem:
    """The terms. Rotations are perturbed on the right, R exp(phi).

    After the poses come the unknowns that they share: the log scale, the log gain along gravity, and the rotation of gravity about
    two axes perpendicular to it. Gravity's length does not determine the scale: each axis of an accelerometer has its own gain,
    and that of the vertical one is not that of the motion.
    """

    measured: Preintegrated
    world_from_camera: Rigid3
    camera_from_imu: Rigid3
    noise: ImuNoise
    path_sigma: tuple[float, float]
    """Standard deviation of a position, in the trajectory's unit, and of a rotation in radians."""
    integrated_at: np.ndarray
    """(3,) gyroscope bias used in the preintegration."""
    is_metric: bool = False
    """Whether the trajectory is in meters: then its scale is the accelerometer's gain."""

    whitening: np.ndarray = field(init=False)
    """(m, 9, 9) inverse Cholesky factors of the measurements' covariances."""

    def __post_init__(self) -> None:
        """Compute what all evaluations share."""
        object.__setattr__(self, "whitening", np.linalg.inv(np.linalg.cholesky(self.measured.covariance)))

    @property
    def scale_column(self) -> int:
        """Column of the log scale; those of gravity come next."""
        return LANES * len(self.world_from_camera.translation)

    @property
    def num_unknowns(self) -> int:
        """Number of columns."""
        return self.scale_column + SHARED

    def cost(self, states: States) -> float:
        """Half the sum of squares."""
        return 0.5 * sum(
            float((terms.residual**2).sum()) for terms in self._terms(states, differentiate=False)
        )

    def misfit(self, states: States) -> float:
        """Square root of chi^2 per degree of freedom."""
        count = sum(terms.residual.size for terms in self._terms(states, differentiate=False)) - int(
            not self.is_metric
        )
        return float(np.sqrt(2.0 * self.cost(states) / max(count - self.num_unknowns, 1)))

    def moved(self, states: States, step: np.ndarray) -> States:
        """The states after a step."""
        own = step[: self.scale_column].reshape(-1, LANES)
        rotation = across_gravity(states.gravity) @ step[self.scale_column + 2 :]
        grown = np.clip(step[self.scale_column : self.scale_column + 2], -1.0, 1.0)
        return States(
            states.rotation @ Rotation3.exp(own[:, :3]).matrix,
            states.velocity + own[:, 3:6],
            states.position + own[:, 6:9],
            states.bias + own[:, 9:],
            states.log_scale + float(grown[0]),
            np.exp(grown[1]) * Rotation3.exp(rotation).apply(states.gravity),
        )

    def normal_equations(self, states: States) -> tuple[scipy.sparse.csc_matrix, np.ndarray]:
        """Matrix and gradient."""
        terms = self._terms(states)
        jacobian = scipy.sparse.vstack([self._jacobian(one) for one in terms]).tocsc()
        residual = np.concatenate([one.residual.ravel() for one in terms])
        return (jacobian.T @ jacobian).tocsc(), jacobian.T @ residual

    def variance_factors(self, states: States) -> tuple[float, float, float, float]:
        """Factors by which to scale the assumed variances of gyroscope, accelerometer, positions and rotations.

        Variance components (Koch, Parameter estimation and hypothesis testing in linear models, 1999, section 3.6): the
        sum of squares of each kind over its redundancy, m - trace(J N^-1 J^T).
        """
        normal, _ = self.normal_equations(states)
        inverse = _inverse(normal.toarray() + 1e-12 * np.eye(normal.shape[0]))
        imu, _, positions, rotations, *_ = self._terms(states)
        out = []
        for terms, rows in (
            (imu, slice(0, 3)),
            (imu, slice(3, 9)),
            (positions, slice(3)),
            (rotations, slice(3)),
        ):
            m, r = terms.residual.shape
            own = np.arange(m * r).reshape(m, r)[:, rows].ravel()
            jacobian = self._jacobian(terms).tocsr()[own]
            used = np.asarray(jacobian.multiply(jacobian @ inverse).sum())
            squares = float((terms.residual[:, rows] ** 2).sum())
            out.append(squares / max(len(own) - float(used), 1e-3 * len(own)))
        return out[0], out[1], out[2], out[3]

    def _jacobian(self, terms: Terms) -> scipy.sparse.coo_matrix:
        m, r = terms.residual.shape
        rows, columns, values = [], [], []
        for first, block in terms.blocks:
            own = np.broadcast_to(np.arange(m * r).reshape(m, r, 1), block.shape)
            rows.append(own.ravel())
            across = np.reshape(first, (-1, 1, 1)) + np.arange(block.shape[2])
            columns.append(np.broadcast_to(across, block.shape).ravel())
            values.append(block.ravel())
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return scipy.sparse.coo_matrix(entries, shape=(m * r, self.num_unknowns))

    def _terms(self, states: States, *, differentiate: bool = True) -> list[Terms]:
        imu, walk, first, gains = self.imu_terms(states, differentiate=differentiate)
        return [imu, walk, self._of_poses(states), self._of_rotations(states), first, gains]

    def imu_terms(self, states: States, *, differentiate: bool = True) -> list[Terms]:
        """Terms that poses do not enter: measurements, bias random walk, and the priors of the first bias and of the gains.

        Without `differentiate`, the measurements have no Jacobian blocks.
        """
        return [
            self._of_imu(states, differentiate=differentiate),
            self._of_walk(states),
            self._of_first_bias(states),
            self._of_gains(states),
        ]

    def _of_imu(self, states: States, *, differentiate: bool = True) -> Terms:
        """Equations 45 of Forster et al. 2017, and their derivatives (A.21 to A.33)."""
        data, m = self.measured, len(self.measured.seconds)
        used = np.concatenate([self.integrated_at, np.zeros(3)])
        measured = (
            data.seconds,
            data.rotation,
            data.velocity,
            data.position,
            data.by_bias,
            used,
            self.whitening,
        )
        own = tuple(np.ascontiguousarray(one) for one in states[:4])
        tilt = -skew(states.gravity) @ across_gravity(states.gravity)
        by_gravity = np.concatenate([states.gravity[:, None], tilt], axis=1)
        out = np.empty((m, 9)), np.empty((m, 9, LANES)), np.empty((m, 9, 9)), np.empty((m, 9, 3))
        kernels.compare(own, (states.gravity, by_gravity), measured, differentiate, out)
        if not differentiate:
            return Terms(out[0], [])
        first = LANES * np.arange(m)
        return Terms(out[0], [*zip((first, first + LANES, np.array(self.scale_column + 1)), out[1:])])

    def _of_walk(self, states: States) -> Terms:
        dt = np.sqrt(self.measured.seconds)[:, None]
        sigma = np.repeat([self.noise.gyro_walk, self.noise.accel_walk], 3) * dt
        first = LANES * np.arange(len(dt)) + 9
        weight = np.eye(6) / sigma[:, :, None]
        return Terms(np.diff(states.bias, axis=0) / sigma, [(first, -weight), (first + LANES, weight)])

    def _of_poses(self, states: States) -> Terms:
        """Camera position by the IMU state, in the trajectory's unit, minus that of the trajectory."""
        shrunk, sigma = np.exp(-states.log_scale), self.path_sigma[0]
        mount = self.camera_from_imu.inverse().translation
        metric = states.position + states.rotation @ mount
        off = (shrunk * metric - self.world_from_camera.translation) / sigma
        n = len(off)
        by_state = np.zeros((n, 3, 9))
        by_state[:, :, :3] = -shrunk / sigma * states.rotation @ skew(mount)
        by_state[:, :, 6:] = np.eye(3) * shrunk / sigma
        by_scale = (-shrunk / sigma * metric)[..., None]
        return Terms(off, [(LANES * np.arange(n), by_state), (np.array(self.scale_column), by_scale)])

    def _of_rotations(self, states: States) -> Terms:
        seen = self.world_from_camera.rotation @ self.camera_from_imu.rotation
        off = Rotation3(np.swapaxes(seen, 1, 2) @ states.rotation).log()
        by_rotation = _of_rotation(off) / self.path_sigma[1]
        return Terms(off / self.path_sigma[1], [(LANES * np.arange(len(off)), by_rotation)])

    def _of_first_bias(self, states: States) -> Terms:
        sigma = np.repeat([self.noise.gyro_bias_sigma, self.noise.accel_bias_sigma], 3)
        return Terms(states.bias[:1] / sigma, [(np.array(9), np.diag(1.0 / sigma)[None])])

    def _of_gains(self, states: States) -> Terms:
        """Along the motion, if that is in meters, and along gravity."""
        weight = np.array([self.is_metric, 1.0]) / self.noise.accel_gain_sigma
        residual = weight * [states.log_scale, states.log_gain]
        return Terms(residual[None], [(np.array(self.scale_column), np.diag(weight)[None])])


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric positive matrix; by its Cholesky factor it takes a third of the time of a general one.

    Raises:
        LinAlgError: it is not positive.
    """
    factor, failed = scipy.linalg.lapack.dpotrf(matrix, lower=True)
    if failed:
        raise np.linalg.LinAlgError("the normal matrix is singular")
    half, _ = scipy.linalg.lapack.dpotri(factor, lower=True)
    return np.tril(half) + np.tril(half, -1).T


def _of_rotation(rotation: np.ndarray) -> np.ndarray:
    """(n, 3, 3) inverse right Jacobian of SO(3), from that of SE(3) without translation."""
    motion = np.concatenate([np.zeros_like(rotation), rotation], axis=1)
    return inverse_right_jacobian(motion)[:, 3:, 3:]


def across_gravity(gravity: np.ndarray) -> np.ndarray:
    """(3, 2) two unit axes perpendicular to gravity."""
    unit = gravity / np.linalg.norm(gravity)
    first = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(unit, first)], axis=1)
