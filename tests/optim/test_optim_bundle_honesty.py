"""Bad, degenerate and hostile bundle problems: each gets a reason or a clear error, and inputs stay as they are."""

from dataclasses import fields, replace

import numpy as np
import pytest
from bundle_rings import ring

from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.optim import (
    BundleConfig,
    BundlePriors,
    LinearSolver,
    Loss,
    PointDistances,
    PointPositions,
    StopReason,
    adjust_bundle,
    with_fixed_gauge,
    with_result,
)

pytestmark = pytest.mark.usefixtures("unchecked")  # many small calls, of types that other tests check


def without(problem, drop):
    """The problem without the observations of a mask."""
    owner = np.repeat(np.arange(len(problem.points_in_world)), np.diff(problem.offsets))[~drop]
    counts = np.bincount(owner, minlength=len(problem.points_in_world))
    parts = {name: getattr(problem, name)[~drop] for name in ("frame", "sensor", "camera", "pixels")}
    return replace(problem, offsets=np.concatenate([[0], np.cumsum(counts)]), **parts)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_pixels_that_are_no_pixels_are_left_out_and_counted(rng, value):
    _, start = ring(rng)
    pixels = start.pixels.copy()
    pixels[[3, 70]] = value
    result = adjust_bundle(replace(start, pixels=pixels))
    assert result.converged and np.flatnonzero(~result.used_mask).tolist() == [3, 70]
    assert "2 observations ignored" in str(result)
    clean = adjust_bundle(without(start, np.isin(np.arange(len(pixels)), [3, 70])))
    assert result.final_cost == pytest.approx(clean.final_cost, rel=1e-6)


def test_points_that_are_not_finite_or_behind_are_left_out(rng):
    _, start = ring(rng)
    points = start.points_in_world.copy()
    points[0], points[1] = np.nan, [100.0, 0.0, 0.0]  # behind some of the cameras
    result = adjust_bundle(replace(start, points_in_world=points))
    unused = ~result.used_mask
    assert unused[: start.offsets[1]].all() and unused[start.offsets[1] : start.offsets[2]].any()
    assert not unused[start.offsets[2] :].any() and np.isnan(result.points_in_world[0]).all()
    assert np.isfinite(result.final_cost) and np.isfinite(result.points_in_world[2:]).all()


def test_places_that_are_not_finite_are_left_out(rng):
    _, start = ring(rng)
    translation = start.rig_from_world.translation.copy()
    translation[3] = np.nan
    result = adjust_bundle(replace(start, rig_from_world=Rigid3(start.rig_from_world.rotation, translation)))
    np.testing.assert_array_equal(result.used_mask, start.frame != 3)
    assert np.isfinite(np.delete(result.rig_from_world.translation, 3, axis=0)).all()


def test_nothing_that_can_be_used_is_said(rng):
    _, start = ring(rng)
    result = adjust_bundle(replace(start, pixels=np.full_like(start.pixels, np.nan)))
    assert result.reason is StopReason.NO_OBSERVATIONS and not result.converged
    empty = without(start, np.ones(len(start.frame), bool))
    assert adjust_bundle(empty).reason is StopReason.NO_OBSERVATIONS


def test_no_points_no_frames_nothing_free(rng):
    _, start = ring(rng)
    nothing = replace(
        start,
        rig_from_world=Rigid3.identity(0),
        points_in_world=np.empty((0, 3)),
        offsets=np.zeros(1, np.int64),
        frame=np.empty(0, np.int32),
        sensor=np.empty(0, np.int32),
        camera=np.empty(0, np.int32),
        pixels=np.empty((0, 2)),
        frame_free=np.empty((0, 6)),
        point_free=np.empty(0),
    )
    assert adjust_bundle(nothing).reason is StopReason.NOTHING_TO_DO
    fixed = replace(
        start,
        frame_free=np.zeros_like(start.frame_free),
        params_free=np.zeros_like(start.params_free),
        point_free=np.zeros_like(start.point_free),
    )
    result = adjust_bundle(fixed)
    assert result.reason is StopReason.NOTHING_TO_DO and result.final_cost == result.initial_cost > 0


@pytest.mark.parametrize("solver", [LinearSolver.DIRECT, LinearSolver.ITERATIVE])
def test_two_scenes_that_never_meet_are_both_adjusted(rng, solver):
    _, one = ring(rng, num_frames=6, num_points=60)
    _, two = ring(rng, num_frames=5, num_points=50)
    away = Rigid3(np.eye(3)[None], np.array([[1000.0, 0.0, 0.0]]))
    both = replace(
        one,
        rig_from_world=Rigid3(
            np.concatenate([one.rig_from_world.rotation, (two.rig_from_world @ away.inverse()).rotation]),
            np.concatenate(
                [one.rig_from_world.translation, (two.rig_from_world @ away.inverse()).translation]
            ),
        ),
        camera_model=np.repeat(one.camera_model, 2),
        camera_params=np.repeat(one.camera_params, 2, axis=0),
        params_free=np.repeat(one.params_free, 2, axis=0),
        points_in_world=np.concatenate([one.points_in_world, away.apply(two.points_in_world)]),
        offsets=np.concatenate([one.offsets, one.offsets[-1] + two.offsets[1:]]),
        frame=np.concatenate([one.frame, two.frame + np.int32(6)]),
        sensor=np.concatenate([one.sensor, two.sensor]),
        camera=np.concatenate([one.camera, two.camera + np.int32(1)]),
        pixels=np.concatenate([one.pixels, two.pixels]),
        frame_free=np.ones((11, 6)),
        point_free=np.ones(110),
    )
    config = BundleConfig(solver=solver, function_tolerance=1e-9)
    together, apart = adjust_bundle(both, config), [adjust_bundle(p, config) for p in (one, two)]
    assert together.final_cost == pytest.approx(sum(r.final_cost for r in apart), rel=1e-5)


def test_a_camera_with_two_observations_and_a_point_with_one(rng):
    _, start = ring(rng)
    of_frame = np.flatnonzero(start.frame == 2)
    drop = np.zeros(len(start.frame), bool)
    drop[of_frame[2:]] = True
    drop[start.offsets[9] : start.offsets[10] - 1] = True
    result = adjust_bundle(with_fixed_gauge(without(start, drop)))
    assert result.converged and result.final_cost < result.initial_cost
    assert "1 frames with fewer than three observations" in str(result)
    assert "1 points observed once" in str(result)
    assert np.isfinite(result.rig_from_world.translation).all() and np.isfinite(result.points_in_world).all()


def test_the_same_observation_many_times_counts_many_times(rng):
    _, start = ring(rng, num_points=40)
    twice = replace(
        start,
        offsets=2 * start.offsets,
        **{
            name: np.repeat(getattr(start, name), 2, axis=0)
            for name in ("frame", "sensor", "camera", "pixels")
        },
    )
    once, double = adjust_bundle(start), adjust_bundle(twice)
    assert double.final_cost == pytest.approx(2 * once.final_cost, rel=1e-6)


def test_huge_coordinates_and_a_huge_focal_length(rng):
    """In micrometers, or by a lens of a billion pixels: the damping is a share of the problem's own scales."""
    _, start = ring(rng)
    here = adjust_bundle(start, BundleConfig(function_tolerance=1e-9))
    scaled = replace(
        start,
        rig_from_world=Rigid3(start.rig_from_world.rotation, 1e6 * start.rig_from_world.translation),
        points_in_world=1e6 * start.points_in_world,
    )
    assert adjust_bundle(scaled, BundleConfig(function_tolerance=1e-9)).final_cost == pytest.approx(
        here.final_cost, rel=1e-6
    )
    zoomed = replace(
        start, pixels=1e6 * start.pixels, camera_params=start.camera_params * [[1e6, 1e6, 1e6, *[1] * 9]]
    )
    found = adjust_bundle(zoomed, BundleConfig(function_tolerance=1e-9))
    assert found.final_cost == pytest.approx(1e12 * here.final_cost, rel=1e-5)


def test_all_points_in_one_place_or_on_one_line_end(rng):
    _, start = ring(rng, num_points=30)
    for points in (np.zeros((30, 3)), np.linspace(-1, 1, 30)[:, None] * [[1.0, 0.5, 0.2]]):
        result = adjust_bundle(replace(start, points_in_world=points), BundleConfig(max_iterations=30))
        assert np.isfinite(result.final_cost) and result.final_cost <= result.initial_cost


@pytest.mark.parametrize("loss", list(Loss))
def test_every_loss_lowers_its_cost(rng, loss):
    _, start = ring(rng)
    pixels = start.pixels.copy()
    pixels[::17] += 25.0
    result = adjust_bundle(
        with_fixed_gauge(replace(start, pixels=pixels)), BundleConfig(loss=loss, loss_scale_px=5.0)
    )
    assert result.final_cost < result.initial_cost and result.converged


def test_inputs_stay_as_they_are(rng):
    _, start = ring(rng, num_sensors=2)
    priors = BundlePriors(position_in_world=start.rig_from_world.centers())
    problem = replace(start, priors=priors, sensor_free=np.ones((2, 6)))
    copies = {
        f.name: np.copy(getattr(problem, f.name))
        for f in fields(problem)
        if isinstance(getattr(problem, f.name), np.ndarray)
    }
    motion = problem.rig_from_world.translation.copy()
    result = adjust_bundle(problem)
    for name, before in copies.items():
        np.testing.assert_array_equal(getattr(problem, name), before)
    np.testing.assert_array_equal(problem.rig_from_world.translation, motion)
    assert not np.shares_memory(result.points_in_world, problem.points_in_world)


def test_canceled_and_resumed_it_ends_where_it_would_have(rng):
    _, start = ring(rng)
    problem = with_fixed_gauge(start)
    whole = adjust_bundle(problem, BundleConfig(function_tolerance=1e-10))
    seen = []
    part = adjust_bundle(problem, progress=lambda step: seen.append(step) or len(seen) < 2)
    assert part.reason is StopReason.CANCELED and part.num_iterations == 2 and len(part.history) == 2
    assert seen[-1].cost == part.final_cost and seen[0].seconds <= seen[1].seconds
    config = BundleConfig(function_tolerance=1e-10, initial_damping=part.damping)
    resumed = adjust_bundle(with_result(problem, part), config)
    assert resumed.initial_cost == pytest.approx(part.final_cost, rel=1e-12)
    assert resumed.final_cost == pytest.approx(whole.final_cost, rel=1e-9)


def test_the_report_says_what_happened(rng):
    _, start = ring(rng)
    result = adjust_bundle(start)
    text = str(result)
    assert "8 frames, 1 free cameras, 150 points, 750 observations" in text and "direct" in text
    assert text.count("\n") > 6 and f"{result.final_cost:.9g}" in text
    assert f"{result.num_iterations} iterations" in repr(result)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"offsets": np.arange(10)}, "offsets"),
        ({"frame_free": np.ones((3, 6))}, "frame_free"),
        ({"sensor_free": np.ones((4, 6))}, "sensor_free"),
        ({"camera": np.full(750, 3, np.int32)}, "a camera that does not exist"),
        ({"frame": np.full(750, -1, np.int32)}, "a frame that does not exist"),
    ],
)
def test_arrays_that_do_not_fit_raise(rng, changes, message):
    _, start = ring(rng)
    with pytest.raises(ShapeError, match=message):
        replace(start, **changes)


@pytest.mark.parametrize(
    "wrong",
    [
        {"loss_scale_px": 0.0},
        {"max_iterations": -1},
        {"function_tolerance": np.nan},
        {"initial_damping": 0.0},
    ],
)
def test_options_that_make_no_sense_raise(wrong):
    with pytest.raises(ConfigError):
        BundleConfig(**wrong)


def bar(first, second, sigma):
    return PointDistances(np.array([first]), np.array([second]), np.array([1.0]), np.array([sigma]))


def surveyed(rows, expected=1.0, sigma=0.1):
    size = (len(rows), 3)
    return PointPositions(np.array(rows), np.full(size, expected), np.full(size, sigma))


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"position_in_world": np.zeros((3, 3))}, ShapeError, "position_in_world"),
        ({"position_sigma": 0.0}, ConfigError, "position_sigma"),
        ({"position_sigma": np.ones((2, 3))}, ShapeError, "position_sigma"),
        ({"down_in_rig": np.zeros((1, 3))}, ShapeError, "down_in_rig"),
        ({"down_sigma_rad": -1.0}, ConfigError, "down_sigma_rad"),
        ({"rig_information": -np.tile(np.eye(6), (8, 1, 1))}, ConfigError, "positive definite"),
        ({"rig_from_world": Rigid3.identity(2)}, ShapeError, "rig_from_world"),
        ({"params_sigma": np.zeros((1, 12))}, ConfigError, "params_sigma"),
        ({"points": surveyed([150])}, ShapeError, "a point that does not exist"),
        ({"points": surveyed([3, 3])}, ShapeError, "two measured positions"),
        ({"points": surveyed([3], sigma=0.0)}, ConfigError, "sigma must be positive"),
        ({"points": surveyed([3], expected=np.nan)}, ConfigError, "not finite"),
        ({"distances": bar(0, 150, 1.0)}, ShapeError, "a point that does not exist"),
        ({"distances": bar(-1, 3, 1.0)}, ShapeError, "a point that does not exist"),
        ({"distances": bar(3, 3, 1.0)}, ShapeError, "to itself"),
        ({"distances": bar(0, 3, 0.0)}, ConfigError, "sigma must be positive"),
    ],
)
def test_priors_that_make_no_sense_raise(rng, wrong, error, message):
    _, start = ring(rng)
    with pytest.raises(error, match=message):
        replace(start, priors=BundlePriors(**wrong))
