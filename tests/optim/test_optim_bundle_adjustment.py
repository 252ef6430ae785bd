"""Bundle adjustment reaches the noise floor, respects what is held, and is the same for any number of threads."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_rings import NOISE_PX, ring

from epipole import _parallel
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3, align_points
from epipole.optim import (
    BundleConfig,
    BundlePriors,
    BundleProblem,
    LinearSolver,
    Loss,
    adjust_bundle,
    evaluate_loss,
    with_fixed_gauge,
)
from epipole.optim import _loss_kernels as kernels
from epipole.optim.bundle_layout import initial_state
from epipole.optim.bundle_system import BundleSystem


def expected_cost(problem):
    unknowns = 6 * len(problem.frame_free) + 3 * len(problem.point_free) + problem.params_free.sum() - 7
    return 0.5 * NOISE_PX**2 * (2 * len(problem.frame) - unknowns)


@pytest.mark.parametrize("num_sensors", [1, 2])
def test_reaches_the_noise_floor_and_the_truth(rng, num_sensors):
    truth, start = ring(rng, num_sensors=num_sensors)
    result = adjust_bundle(with_fixed_gauge(start), BundleConfig(function_tolerance=1e-9))
    assert result.converged and result.final_cost < result.initial_cost
    assert abs(result.final_cost / expected_cost(start) - 1) < 0.15
    aligned = align_points(result.points_in_world, truth.points_in_world)
    assert np.linalg.norm(aligned.apply(result.points_in_world) - truth.points_in_world, axis=1).mean() < 0.01
    assert abs(result.camera_params[0, 0] / truth.camera_params[0, 0] - 1) < 0.01


def test_the_step_solves_the_full_normal_equations(rng):
    """The Schur complement and the substitution give what one dense solve over all unknowns gives."""
    _, start = ring(rng, num_frames=4 + 1, num_points=12)
    problem = with_fixed_gauge(start)
    system = BundleSystem(problem, Loss.TRIVIAL, 1.0, LinearSolver.DIRECT, single_precision=False)
    state = initial_state(problem)
    system.find_visible(state)
    equations = system.linearize(state, 1e-12)
    moved, _ = system.substitute_back(state, equations, system.solve(equations)[0], 1e-12)
    fixed = replace(problem, frame_free=problem.frame_free)

    def residuals(xi, params, points):
        camera = Camera(CameraModel.RADIAL, 1000, 800, params[:5])
        frames = Rigid3.exp(xi) @ fixed.rig_from_world
        owner = np.repeat(np.arange(len(points)), np.diff(fixed.offsets))
        return (camera.project(frames[fixed.frame].apply(points[owner])) - fixed.pixels).ravel()

    zero, params, points = np.zeros((5, 6)), fixed.camera_params[0].copy(), fixed.points_in_world
    columns, names = [], []
    for f, c in zip(*np.nonzero(fixed.frame_free)):
        d = zero.copy()
        d[f, c] = 1e-6
        columns.append((residuals(d, params, points) - residuals(-d, params, points)) / 2e-6)
        names.append(("frame", f, c))
    for c in np.flatnonzero(fixed.params_free[0]):
        d = np.zeros(12)
        d[c] = 1e-6 * max(1.0, abs(params[c]))
        columns.append(
            (residuals(zero, params + d, points) - residuals(zero, params - d, points)) / (2 * d[c])
        )
        names.append(("params", 0, c))
    for p in range(len(points)):
        for c in range(3):
            d = np.zeros_like(points)
            d[p, c] = 1e-6
            columns.append((residuals(zero, params, points + d) - residuals(zero, params, points - d)) / 2e-6)
            names.append(("point", p, c))
    step = np.linalg.lstsq(np.stack(columns, axis=1), -residuals(zero, params, points), rcond=None)[0]
    expected_points = points.copy()
    for (what, i, c), value in zip(names, step):
        if what == "point":
            expected_points[i, c] += value
        if what == "params":
            assert abs(moved.params[0, c] - params[c] - value) < 1e-3 * max(1.0, abs(value))
    np.testing.assert_allclose(moved.points, expected_points, atol=2e-4)


def test_what_is_held_stays(rng):
    _, start = ring(rng)
    fixed = replace(
        start,
        frame_free=np.concatenate([np.zeros((2, 6)), np.ones((6, 6))]),
        params_free=np.zeros((1, 12)),
        point_free=np.concatenate([np.zeros(20), np.ones(130)]),
    )
    result = adjust_bundle(fixed)
    np.testing.assert_array_equal(result.rig_from_world.translation[:2], start.rig_from_world.translation[:2])
    np.testing.assert_array_equal(result.camera_params, start.camera_params)
    np.testing.assert_array_equal(result.points_in_world[:20], start.points_in_world[:20])
    assert result.final_cost < result.initial_cost


def test_the_gauge_is_held(rng):
    _, start = ring(rng)
    fixed = with_fixed_gauge(start)
    assert (fixed.frame_free == 0).sum() == 7
    assert with_fixed_gauge(fixed) is fixed or (with_fixed_gauge(fixed).frame_free == fixed.frame_free).all()


def test_outliers_do_not_spoil_a_robust_adjustment(rng):
    truth, start = ring(rng)
    pixels = start.pixels.copy()
    wrong = rng.permutation(len(pixels))[: len(pixels) // 20]
    pixels[wrong] += 60 * rng.normal(size=(len(wrong), 2))
    spoiled = with_fixed_gauge(replace(start, pixels=pixels))

    def error(loss):
        found = adjust_bundle(spoiled, BundleConfig(loss=loss, loss_scale_px=1.0)).points_in_world
        return np.median(
            np.linalg.norm(
                align_points(found, truth.points_in_world).apply(found) - truth.points_in_world, axis=1
            )
        )

    assert error(Loss.CAUCHY) < 0.5 * error(Loss.TRIVIAL)


def test_position_priors_pull_frames(rng):
    truth, start = ring(rng)
    shifted = truth.rig_from_world.centers() + np.array([3.0, 0, 0])
    result = adjust_bundle(
        replace(start, priors=BundlePriors(position_in_world=shifted, position_sigma=0.5)),
        BundleConfig(max_iterations=100),
    )
    assert np.abs(result.rig_from_world.centers() - shifted).max() < 0.1


def test_same_result_for_any_number_of_threads(rng):
    _, start = ring(rng)
    problem = with_fixed_gauge(start)
    results = []
    for threads in (1, 2, 5):
        _parallel.set_num_threads(threads)
        results.append(adjust_bundle(problem))
    _parallel.set_num_threads(None)
    for other in results[1:]:
        np.testing.assert_array_equal(results[0].points_in_world, other.points_in_world)
        assert results[0].final_cost == other.final_cost


def test_no_points_is_no_work(rng):
    """Without an observation nothing is wrong and nothing moves."""
    _, start = ring(rng)
    none, no_rows = np.zeros(0, np.int32), {"points_in_world": np.zeros((0, 3)), "pixels": np.zeros((0, 2))}
    empty = replace(
        start,
        **no_rows,
        offsets=np.zeros(1, np.int64),
        frame=none,
        sensor=none,
        camera=none,
        point_free=np.zeros(0),
    )
    result = adjust_bundle(empty)
    assert result.initial_cost == result.final_cost == 0.0
    np.testing.assert_array_equal(result.rig_from_world.as_matrix(), start.rig_from_world.as_matrix())
    np.testing.assert_array_equal(result.camera_params, start.camera_params)
    assert result.points_in_world.shape == (0, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: {"offsets": p.offsets[:-1]}, "offsets must have 151 rows, got 150"),
        (lambda p: {"offsets": p.offsets[::-1].copy()}, "offsets must increase from 0"),
        (lambda p: {"frame": p.frame + np.int32(1)}, "refers to a frame that does not exist"),
        (lambda p: {"camera": p.camera - np.int32(1)}, "refers to a camera that does not exist"),
    ],
)
def test_misfits_raise(rng, change, message):
    _, start = ring(rng)
    with pytest.raises(ShapeError, match=message):
        adjust_bundle(replace(start, **change(start)))


@pytest.mark.parametrize("loss", list(Loss))
def test_losses_agree_with_the_kernel_and_their_derivative(loss):
    squared, scale = np.array([0.0, 0.3, 0.9, 1.5, 4.0, 100.0]), 1.2
    values = evaluate_loss(loss, squared, scale)
    for s, value in zip(squared, values):
        rho, slope = kernels.robust_loss(int(loss), float(s), scale**2)
        assert abs(rho - value) < 1e-12
        h = 1e-6
        numeric = (evaluate_loss(loss, s + h, scale) - evaluate_loss(loss, max(s - h, 0), scale)) / (
            s + h - max(s - h, 0)
        )
        assert abs(slope - numeric) < 1e-3


@pytest.mark.parametrize("num_cameras", [1, 3])
def test_a_problem_of_tracks_in_any_order_reaches_the_truth(num_cameras, rng):
    camera = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 500.0, 319.5, 239.5]))
    poses = Rigid3.stack([Rigid3.exp([-0.5 * k, 0.0, 0.0, 0.0, 0.1 * k, 0.0]) for k in range(3)])
    points = rng.uniform([-1.5, -1.0, 4.0], [1.5, 1.0, 6.0], (40, 3))
    image, point = (a.ravel() for a in np.meshgrid(np.arange(3), np.arange(40)))
    order = rng.permutation(len(image))
    image, point = image[order], point[order]
    pixels = np.stack([camera.project(pose.apply(points)) for pose in poses])[image, point]
    cameras = camera if num_cameras == 1 else [camera] * num_cameras
    start = points + rng.normal(0.0, 0.05, points.shape)
    problem = BundleProblem.from_tracks(poses, cameras, start, image, point, pixels)
    found = adjust_bundle(with_fixed_gauge(problem), BundleConfig(function_tolerance=1e-12))
    assert found.final_cost < 1e-12 and len(problem.camera_params) == num_cameras
    aligned = align_points(found.points_in_world, points)
    np.testing.assert_allclose(aligned.apply(found.points_in_world), points, atol=1e-6)
    for wrong in (
        (poses, [camera] * 2, start, image, point, pixels),
        (poses, [], start, image, point, pixels),
    ):
        with pytest.raises(ConfigError, match="one per image"):
            BundleProblem.from_tracks(*wrong)
    with pytest.raises(ShapeError, match="point must be"):
        BundleProblem.from_tracks(poses, cameras, start[:5], image, point, pixels)
    with pytest.raises(ShapeError, match="frame that does not exist"):
        BundleProblem.from_tracks(poses[:2], camera, start, image, point, pixels)
