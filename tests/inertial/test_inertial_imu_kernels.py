"""Kernels of the IMU: laws of the rotation's derivatives, differences of the residuals, and the interpreter."""

import numpy as np
import pytest

from epipole.geometry import Rotation3
from epipole.inertial import _imu_kernels as kernels
from epipole.inertial import _inertial_problem, align_path_to_imu, factors, imu_factors, preintegration
from epipole.inertial._inertial_problem import LANES, SHARED, InertialProblem, States
from epipole.synthetic.inertial import inertial_path
from kernel_references import assert_same_as_python, record_calls, reference_of

ANGLES = [0.0, 1e-9, 9e-5, 1.1e-4, 9.9e-3, 0.0101, 0.5, 3.0, np.pi - 1e-6]


@pytest.mark.parametrize("angle", ANGLES)
def test_rotations_and_their_derivatives(rng, angle):
    vector = rng.normal(size=3)
    vector *= angle / np.linalg.norm(vector)
    rotation, right, inverse = (np.empty((3, 3)) for _ in range(3))
    found, step, numeric = np.empty(3), 1e-5, np.empty((3, 3))
    kernels._exponential(*vector, rotation)
    np.testing.assert_allclose(rotation, Rotation3.exp(vector).matrix, atol=1e-15)
    kernels._logarithm(rotation, found)
    np.testing.assert_allclose(found, vector, atol=1e-14)
    kernels._right_jacobian(*vector, right)
    kernels._inverse_right_jacobian(*vector, inverse)
    np.testing.assert_allclose(right @ inverse, np.eye(3), atol=1e-14)
    for k, change in enumerate(step * np.eye(3)):
        ends = [Rotation3(rotation.T @ Rotation3.exp(vector + s * change).matrix).log() for s in (1, -1)]
        numeric[:, k] = (ends[0] - ends[1]) / (2 * step)
    np.testing.assert_allclose(right, numeric, atol=1e-10)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_half_a_rotation_has_a_logarithm(axis, sign):
    vector, found = np.zeros(3), np.empty(3)
    vector[axis] = sign * np.pi
    kernels._logarithm(Rotation3.exp(vector).matrix, found)
    np.testing.assert_allclose(np.abs(found), np.abs(vector), atol=1e-9)


@pytest.fixture(scope="module")
def flight():
    return inertial_path(3, seconds=4.0)


def problem_of(path, *, is_metric):
    imu = path.imu()
    measured = preintegration.preintegrate(imu.log, path.timestamp_s)
    return InertialProblem(
        measured, path.world_from_camera, imu.camera_from_imu, imu.noise, (0.01, 0.01), np.zeros(3), is_metric
    )


@pytest.mark.parametrize("is_metric", [False, True])
def test_derivatives_are_differences_of_the_residuals(flight, rng, is_metric):
    """At states far from the measurements: rotations are off by a radian."""
    problem, n = problem_of(flight, is_metric=is_metric), len(flight.timestamp_s)
    rotation = flight.world_from_camera.rotation @ Rotation3.exp(rng.normal(0.0, 0.6, (n, 3))).matrix
    bias = rng.normal(0.0, 0.3, (n, 6))
    states = States(
        rotation, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), bias, 0.2, np.array([1.0, 2.0, -9.4])
    )
    at, width = LANES * 4, 2 * LANES + SHARED
    terms, numeric, step = problem._of_imu(states), np.empty((9, width)), 1e-6
    for k in range(width):
        change = np.zeros(problem.num_unknowns)
        change[at + k if k < 2 * LANES else problem.scale_column + k - 2 * LANES] = step
        ends = [
            problem._of_imu(problem.moved(states, s * change), differentiate=False).residual[4]
            for s in (1, -1)
        ]
        numeric[:, k] = (ends[0] - ends[1]) / (2 * step)
    blocks = [block[4] for _, block in terms.blocks]
    derivatives = np.concatenate([blocks[0], blocks[1], np.zeros((9, 7)), blocks[2]], axis=1)
    np.testing.assert_allclose(derivatives, numeric, atol=1e-7 * np.abs(numeric).max())


@reference_of(kernels.integrate, kernels.compare, kernels.add_normal_equations)
def test_kernels_do_what_is_written(flight, monkeypatch):
    steps = (kernels.integrate, kernels.compare, kernels.add_normal_equations)
    modules = (preintegration, _inertial_problem, factors)
    calls = [record_calls(monkeypatch, module, kernel) for module, kernel in zip(modules, steps)]
    times, poses, imu = flight.timestamp_s, flight.world_from_camera, flight.imu()
    aligned = align_path_to_imu(times, poses, imu)
    found = imu_factors(np.arange(len(times)), times, poses, imu, aligned)
    found.linearized(poses.inverse())
    for recorded, kernel in zip(calls, steps):
        assert recorded
        assert_same_as_python(kernel, *recorded[0], rtol=1e-9, of_largest=1e-12)
        assert_same_as_python(kernel, *recorded[-1], rtol=1e-9, of_largest=1e-12)
