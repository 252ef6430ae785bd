"""Rigs, own lenses, priors and known distances: each term's gradient is the cost's, each does what it says."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_rings import ring

from epipole.geometry import Rigid3, Rotation3, align_points
from epipole.optim import (
    BundleConfig,
    BundlePriors,
    LinearSolver,
    Loss,
    PointDistances,
    adjust_bundle,
    with_fixed_gauge,
)
from epipole.optim.bundle_layout import initial_state
from epipole.optim.bundle_system import BundleSystem

pytestmark = pytest.mark.usefixtures("unchecked")  # many small calls, of types that other tests check


def system_of(problem, loss=Loss.TRIVIAL, solver=LinearSolver.DIRECT):
    system = BundleSystem(problem, loss, 1.0, solver, single_precision=False)
    state = initial_state(problem)
    system.find_visible(state)
    return system, state


def with_own_cameras(problem):
    """Each frame with a camera of its own."""
    n, priors = len(problem.frame_free), problem.priors
    if priors is not None and priors.params_expected is not None:
        expected, sigma = (np.repeat(p, n, axis=0) for p in (priors.params_expected, priors.params_sigma))
        priors = replace(priors, params_expected=expected, params_sigma=sigma)
    return replace(
        problem,
        priors=priors,
        camera_model=np.repeat(problem.camera_model, n),
        camera_params=np.repeat(problem.camera_params, n, axis=0),
        params_free=np.repeat(problem.params_free, n, axis=0),
        camera=problem.frame.copy(),
    )


def all_priors(problem, rng):
    """Every kind of prior at once, none of which the start agrees with."""
    n = len(problem.frame_free)
    information = np.zeros((n, 6, 6))
    factor = rng.normal(size=(n - 3, 6, 6))
    information[3:] = factor @ np.swapaxes(factor, 1, 2) + np.eye(6)
    centers = problem.rig_from_world.centers() + 0.3 * rng.normal(size=(n, 3))
    centers[2] = np.nan
    down = problem.rig_from_world.rotation @ [0.0, 0.0, -1.0] + 0.1 * rng.normal(size=(n, 3))
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    down[4] = np.nan
    return BundlePriors(
        position_in_world=centers,
        position_sigma=rng.uniform(0.1, 0.4, (n, 3)),
        rig_from_world=Rigid3.exp(0.1 * rng.normal(size=(n, 6))) @ problem.rig_from_world,
        rig_information=information,
        down_in_rig=down,
        down_sigma_rad=0.05,
        params_expected=problem.camera_params + 0.01,
        params_sigma=np.full(problem.camera_params.shape, 0.1),
        distances=PointDistances(
            np.array([0, 1, 2]), np.array([5, 6, 0]), np.array([0.5, 1.0, 0.7]), np.array([0.1, 0.2, 0.05])
        ),
    )


def hard_problem(rng, num_sensors=2):
    """Two sensors, one of which may turn, own cameras or a shared one, all priors, and frames held in part."""
    _, start = ring(rng, num_frames=6, num_points=20, num_sensors=num_sensors)
    sensor_free = np.zeros((num_sensors, 6))
    sensor_free[1:] = 1.0
    sensor_free[1:, 2] = 0.0
    free = start.frame_free.copy()
    free[0], free[1, 4] = 0.0, 0.0
    problem = replace(start, sensor_free=sensor_free, frame_free=free)
    return replace(problem, priors=all_priors(problem, rng))


@pytest.mark.parametrize("own_cameras", [False, True])
@pytest.mark.parametrize("num_sensors", [1, 2])
@pytest.mark.parametrize("loss", [Loss.TRIVIAL, Loss.TUKEY])
def test_the_gradient_is_that_of_the_cost(rng, num_sensors, own_cameras, loss):
    problem = hard_problem(rng, num_sensors)
    if own_cameras:
        problem = with_own_cameras(problem)
    system, state = system_of(problem, loss)
    layout = system.layout
    gradient = system.linearize(state, 1e-9).gradient
    checked = 0
    for node in range(layout.num_nodes):
        for column in range(layout.entries.width[node]):
            if layout.fixed_mask[node, column]:
                assert gradient[node, column] == 0.0
                continue
            step, ends = np.zeros((layout.num_nodes, len(layout.lanes))), []
            h = 1e-6
            for sign in (1.0, -1.0):
                step[node, column] = sign * h
                moved = layout.moved(state, step)
                moved.points[:] = state.points
                kept = layout.nodes.point >= 0
                moved.points[kept] += step[layout.nodes.point[kept], :3]
                ends.append(system.cost(moved))
            numeric = (ends[0] - ends[1]) / (2 * h)
            assert gradient[node, column] == pytest.approx(numeric, rel=2e-4, abs=2e-3), (node, column)
            checked += 1
    assert checked > 40


@pytest.mark.parametrize("loss", list(Loss))
def test_the_cost_falls_as_predicted_for_a_small_step(rng, loss):
    problem = hard_problem(rng)
    system, state = system_of(problem, loss)
    damping = 1e5  # a small step down the gradient: its decrease is linear
    equations = system.linearize(state, damping)
    moved, predicted = system.substitute_back(state, equations, system.solve(equations)[0], damping)
    assert system.cost(state) - system.cost(moved) == pytest.approx(predicted, rel=1e-2)


@pytest.mark.parametrize("own_cameras", [False, True])
def test_iterations_and_factorization_find_one_step(rng, own_cameras):
    problem = hard_problem(rng)
    if own_cameras:
        problem = replace(with_own_cameras(problem), priors=None)
    steps = []
    for solver in (LinearSolver.DIRECT, LinearSolver.ITERATIVE):
        system, state = system_of(problem, solver=solver)
        equations = system.linearize(state, 1e-3)
        if solver is LinearSolver.ITERATIVE:
            step = np.zeros_like(equations.rhs)
            residual = equations.rhs - system.product(equations, step)
            for _ in range(8):  # restarted until exact
                step += system.solve(replace(equations, rhs=residual))[0]
                residual = equations.rhs - system.product(equations, step)
            steps.append(step)
        else:
            steps.append(system.solve(equations)[0])
    np.testing.assert_allclose(steps[1], steps[0], rtol=1e-2, atol=1e-3 * np.abs(steps[0]).max())


def test_own_lenses_with_priors_that_tie_them_are_one_lens(rng):
    """Own cameras held by a tight expectation end where the shared camera ends."""
    _, start = ring(rng)
    shared = adjust_bundle(with_fixed_gauge(start), BundleConfig(function_tolerance=1e-12))
    own = with_own_cameras(start)
    expected = np.repeat(shared.camera_params, len(own.frame_free), axis=0)
    is_constrained = BundlePriors(params_expected=expected, params_sigma=np.full(expected.shape, 1e-6))
    found = adjust_bundle(
        with_fixed_gauge(replace(own, priors=is_constrained)), BundleConfig(function_tolerance=1e-12)
    )
    np.testing.assert_allclose(found.camera_params, expected, atol=1e-6)
    assert found.final_cost == pytest.approx(shared.final_cost, rel=1e-6)


def test_a_rig_is_found_with_its_frames(rng):
    truth, start = ring(rng, num_sensors=2)
    wrong = Rigid3.exp(np.array([[0.0] * 6, [0.02, -0.03, 0.01, 0.01, -0.02, 0.01]])) @ truth.cam_from_rig
    sensor_free = np.array([[0.0] * 6, [1.0] * 6])
    problem = with_fixed_gauge(replace(start, cam_from_rig=wrong, sensor_free=sensor_free))
    found = adjust_bundle(problem)
    rotation_error = (found.cam_from_rig[1] @ truth.cam_from_rig[1].inverse()).log()[3:]
    assert found.converged and np.linalg.norm(rotation_error) < 2e-3
    np.testing.assert_array_equal(found.cam_from_rig.rotation[0], wrong.rotation[0])
    fixed = adjust_bundle(replace(problem, sensor_free=None))
    assert fixed.final_cost > 1.5 * found.final_cost


def test_known_distances_give_the_scale(rng):
    truth, start = ring(rng)
    shrunk = replace(
        start,
        rig_from_world=Rigid3(start.rig_from_world.rotation, 0.5 * start.rig_from_world.translation),
        points_in_world=0.5 * start.points_in_world,
    )
    first, second = np.arange(4), np.arange(10, 14)
    lengths = np.linalg.norm(truth.points_in_world[first] - truth.points_in_world[second], axis=1)
    priors = BundlePriors(distances=PointDistances(first, second, lengths, np.full(4, 1e-3)))
    found = adjust_bundle(replace(shrunk, priors=priors), BundleConfig(max_iterations=100))
    between = np.linalg.norm(found.points_in_world[first] - found.points_in_world[second], axis=1)
    np.testing.assert_allclose(between, lengths, atol=5e-3)
    assert float(align_points(found.points_in_world, truth.points_in_world).scale) == pytest.approx(
        1, abs=0.01
    )


def test_gravity_levels_the_model(rng):
    truth, start = ring(rng)
    tilt = Rigid3.exp(np.array([0.0, 0, 0, 0.2, -0.1, 0.0]))
    down = truth.rig_from_world.rotation @ [0.0, 0.0, -1.0]
    tilted = replace(
        start,
        rig_from_world=start.rig_from_world @ tilt.inverse(),
        points_in_world=tilt.apply(start.points_in_world),
        priors=BundlePriors(down_in_rig=down, down_sigma_rad=1e-3),
    )
    found = adjust_bundle(tilted, BundleConfig(max_iterations=100))
    assert np.abs(found.rig_from_world.rotation @ [0.0, 0.0, -1.0] - down).max() < 5e-3


def test_expected_motions_hold_what_nothing_else_does(rng):
    """With no observation to speak of, a frame goes where it is expected."""
    truth, start = ring(rng)
    n = len(start.frame_free)
    priors = BundlePriors(
        rig_from_world=truth.rig_from_world, rig_information=np.tile(1e8 * np.eye(6), (n, 1, 1))
    )
    found = adjust_bundle(replace(start, priors=priors))
    off = (found.rig_from_world @ truth.rig_from_world.inverse()).log()
    assert np.abs(off).max() < 1e-3


def test_held_frames_take_no_part_in_priors(rng):
    _, start = ring(rng)
    far = start.rig_from_world.centers() + 100.0
    problem = replace(
        start, frame_free=np.zeros_like(start.frame_free), priors=BundlePriors(position_in_world=far)
    )
    found = adjust_bundle(problem)
    np.testing.assert_array_equal(found.rig_from_world.translation, start.rig_from_world.translation)


def test_single_precision_reaches_the_same_minimum(rng):
    _, start = ring(rng)
    problem = with_fixed_gauge(start)
    costs = [
        adjust_bundle(
            problem, BundleConfig(single_precision=single, function_tolerance=1e-12, solver=solver)
        ).final_cost
        for single in (False, True)
        for solver in (LinearSolver.DIRECT, LinearSolver.ITERATIVE)
    ]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-9)


def test_euler_angles_of_a_half_turn_do_not_matter(rng):
    """A world turned by half a turn gives the same steps: tangents have no poles."""
    _, start = ring(rng)
    half = Rigid3(Rotation3.exp(np.array([[0.0, np.pi, 0.0]])).matrix[0], np.zeros(3))
    rotated = replace(
        start,
        rig_from_world=start.rig_from_world @ half.inverse(),
        points_in_world=half.apply(start.points_in_world),
    )
    here, there = adjust_bundle(start), adjust_bundle(rotated)
    assert here.num_iterations == there.num_iterations
    assert here.final_cost == pytest.approx(there.final_cost, rel=1e-9)
