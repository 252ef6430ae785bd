"""Covariances of adjusted bundles: those of dense algebra, those of a simulation, and none where nothing is known."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_rings import NOISE_PX, ring
from scipy.stats import chi2

from epipole.cameras import Camera, CameraModel
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.optim import (
    BundleConfig,
    BundlePriors,
    BundleProblem,
    PointDistances,
    PointPositions,
    adjust_bundle,
    bundle_covariance,
    with_fixed_gauge,
)
from whole import IS_WHOLE

EXACT = BundleConfig(function_tolerance=1e-12)


def dense_inverse(problem, result):
    """(J^T J)^-1 by numeric derivatives over all unknowns: of frames, then parameters, then points."""
    positions, points, params = result.rig_from_world, result.points_in_world, result.camera_params[0]
    owner = np.repeat(np.arange(len(points)), np.diff(problem.offsets))

    def residuals(twist, change, shift):
        camera = Camera(CameraModel.RADIAL, 1000, 800, params[:5] + change[:5])
        return camera.project(
            (Rigid3.exp(twist) @ positions)[problem.frame].apply((points + shift)[owner])
        ).ravel()

    zeros = (np.zeros((len(positions.translation), 6)), np.zeros(8), np.zeros_like(points))
    masks = (problem.frame_free, problem.params_free[0], np.repeat(problem.point_free[:, None], 3, axis=1))
    columns, names = [], []
    for part, mask in enumerate(masks):
        for index in zip(*np.nonzero(mask)):
            h = 1e-6 * (max(1.0, abs(params[index[0]])) if part == 1 else 1.0)
            ends = []
            for sign in (1.0, -1.0):
                change = [z.copy() for z in zeros]
                change[part][index] = sign * h
                ends.append(residuals(*change))
            columns.append((ends[0] - ends[1]) / (2 * h))
            names.append((part, index))
    jacobian = np.stack(columns, axis=1)
    return np.linalg.inv(jacobian.T @ jacobian), names


def test_they_are_the_blocks_of_the_dense_inverse(rng):
    _, start = ring(rng, num_frames=5, num_points=25)
    problem = with_fixed_gauge(replace(start, point_free=(np.arange(25) > 2).astype(float)))
    result = adjust_bundle(problem, EXACT)
    found = bundle_covariance(problem, result, noise_px=1.0)
    inverse, names = dense_inverse(problem, result)
    seen = np.zeros(3, int)
    for a, (part, index) in enumerate(names):
        for b, (other, index2) in enumerate(names):
            if part != other or index[: -1 if part != 1 else None] != index2[: -1 if part != 1 else None]:
                continue
            table = (found.rig_from_world, found.camera_params, found.points_in_world)[part]
            value = table[0][index[0], index2[0]] if part == 1 else table[index[0]][index[1], index2[1]]
            assert value == pytest.approx(
                inverse[a, b], rel=1e-5, abs=1e-5 * np.sqrt(inverse[a, a] * inverse[b, b])
            )
            seen[part] += 1
    assert seen.min() >= 3


@pytest.mark.usefixtures("unchecked")
def test_they_hold_in_simulation():
    """Normalized squared errors of frames and points fall where chi-square says, over fifty noises."""
    frames, points = [], []
    for seed in range(50):
        rng = np.random.default_rng(seed)
        truth, start = ring(rng, num_frames=6, num_points=60)
        free = truth.frame_free.copy()
        free[:2] = 0.0  # two held frames give the place and the scale
        fixed = replace(
            start, frame_free=free, params_free=np.zeros((1, 12)), camera_params=truth.camera_params
        )
        positions = (truth.rig_from_world, start.rig_from_world)
        rotation = np.concatenate([positions[0].rotation[:2], positions[1].rotation[2:]])
        translation = np.concatenate([positions[0].translation[:2], positions[1].translation[2:]])
        problem = replace(fixed, rig_from_world=Rigid3(rotation, translation))
        result = adjust_bundle(problem, EXACT)
        found = bundle_covariance(problem, result, noise_px=NOISE_PX)
        error = (result.rig_from_world @ truth.rig_from_world.inverse()).log()[2:]
        frames += [e @ np.linalg.solve(c, e) for e, c in zip(error, found.rig_from_world[2:])]
        shift = result.points_in_world - truth.points_in_world
        points += [e @ np.linalg.solve(c, e) for e, c in zip(shift, found.points_in_world)]
    for squares, freedom in ((frames, 6), (points, 3)):
        for quantile in (0.5, 0.9, 0.99):
            fraction = np.mean(np.array(squares) < chi2.ppf(quantile, freedom))
            # Points of one run share their frames' errors: the band is that of some 200 independent values.
            assert fraction == pytest.approx(quantile, abs=3.5 * np.sqrt(quantile * (1 - quantile) / 200)), (
                freedom
            )


def along_a_row(rng, persistence):
    """Frames side by side before points that all of them see, and each with errors that go on from frame to frame."""
    frames, count = 10, 400
    camera = Camera(CameraModel.SIMPLE_PINHOLE, 640, 480, np.array([500.0, 320.0, 240.0]))
    positions = Rigid3(
        np.tile(np.eye(3), (frames, 1, 1)), np.outer(-0.05 * np.arange(frames), [1.0, 0.0, 0.0])
    )
    points = rng.uniform([-1, -1, 2], [1.5, 1, 5], (count, 3))
    pixels = camera.project((points + positions.translation[:, None]).reshape(-1, 3))
    error = rng.normal(size=(frames, count, 2))
    for n in range(1, frames):
        error[n] = persistence * error[n - 1] + np.sqrt(1 - persistence**2) * error[n]
    seen = pixels.reshape(frames, count, 2) + NOISE_PX * error
    free = np.ones((frames, 6))
    free[0], free[-1] = 0.0, [0, 1, 1, 1, 1, 1]
    none, model = np.zeros(frames * count, np.int32), np.array([int(camera.model)], np.int32)
    return positions, BundleProblem(
        *(positions, Rigid3.identity(1), model, camera.padded_params()[None], points),
        np.arange(count + 1, dtype=np.int64) * frames,
        *(np.tile(np.arange(frames, dtype=np.int32), count), none, none),
        np.swapaxes(seen, 0, 1).reshape(-1, 2),
        *(free, np.zeros((1, 12)), np.ones(count)),
    )


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("persistence", [0.9] + IS_WHOLE * [0.0])
def test_errors_that_go_on_from_frame_to_frame_are_told_by_the_points_scores(persistence):
    """Means of normalized squared errors of the frames between, over sixty draws; 6 is right."""
    clustered, plain = [], []
    for seed in range(60):
        positions, problem = along_a_row(np.random.default_rng(seed), persistence)
        result = adjust_bundle(problem, EXACT)
        error = (result.rig_from_world @ positions.inverse()).log()[1:-1]
        for given, is_clustered in ((clustered, True), (plain, False)):
            found = bundle_covariance(problem, result, clustered=is_clustered)
            given += [e @ np.linalg.solve(c, e) for e, c in zip(error, found.rig_from_world[1:-1])]
    # Frames of one draw share their errors: the band is that of about three independent ones in each.
    assert np.mean(clustered) == pytest.approx(6.0, abs=3.0 * np.sqrt(12.0 / 180))
    assert np.mean(plain) == pytest.approx(6.0, abs=0.8) if persistence == 0 else np.mean(plain) > 12


def test_the_size_alone_of_frames_covariances_changes(rng):
    _, problem = along_a_row(rng, 0.5)
    result = adjust_bundle(problem, EXACT)
    found = bundle_covariance(problem, result, clustered=True)
    plain = bundle_covariance(problem, result)
    np.testing.assert_array_equal(found.points_in_world, plain.points_in_world)
    ratio = found.rig_from_world[1:-1] / plain.rig_from_world[1:-1]
    np.testing.assert_allclose(ratio, ratio[:, :1, :1] * np.ones((6, 6)))  # the size alone changes
    assert not found.rig_from_world[0].any()


def test_the_noise_is_the_residuals_own(rng):
    _, start = ring(rng)
    problem = with_fixed_gauge(start)
    found = bundle_covariance(problem, adjust_bundle(problem, EXACT))
    assert found.noise_px == pytest.approx(NOISE_PX, rel=0.05)


def test_what_is_held_is_known_and_what_nothing_fixes_is_not(rng):
    _, start = ring(rng)
    free = adjust_bundle(start, EXACT)
    everything = bundle_covariance(start, free, noise_px=1.0)
    assert np.isinf(everything.rig_from_world).all() and np.isinf(everything.points_in_world).all()
    fixed = with_fixed_gauge(start)
    found = bundle_covariance(fixed, adjust_bundle(fixed, EXACT), noise_px=1.0)
    first = np.flatnonzero(~fixed.frame_free.any(axis=1))[0]
    assert not found.rig_from_world[first].any() and np.isfinite(found.points_in_world).all()
    assert not found.camera_params[:, 1].any() and found.camera_params[0, 0, 0] > 0


def test_a_point_seen_once_is_not_known(rng):
    _, start = ring(rng)
    keep = np.ones(len(start.frame), bool)
    keep[1 : start.offsets[1]] = False  # of the first point's observations, one
    offsets = np.concatenate([[0], np.cumsum(np.add.reduceat(keep, start.offsets[:-1]))])
    parts = {name: getattr(start, name)[keep] for name in ("frame", "sensor", "camera", "pixels")}
    problem = with_fixed_gauge(replace(start, offsets=offsets, **parts))
    result = adjust_bundle(problem, EXACT)
    found = bundle_covariance(problem, result)
    assert np.isinf(found.points_in_world[0]).all() and np.isfinite(found.points_in_world[1:]).all()
    assert "1 points observed once" in str(result)


def test_known_distances_make_the_scale_known(rng):
    truth, start = ring(rng)
    between = np.linalg.norm(truth.points_in_world[0] - truth.points_in_world[1])
    free = start.frame_free.copy()
    free[0] = 0.0
    unscaled = replace(start, frame_free=free)
    assert np.isinf(bundle_covariance(unscaled, adjust_bundle(unscaled, EXACT)).points_in_world).any()
    bar = PointDistances(np.array([0]), np.array([1]), np.array([between]), np.array([1e-3]))
    scaled = replace(unscaled, priors=BundlePriors(distances=bar))
    found = bundle_covariance(scaled, adjust_bundle(scaled, EXACT))
    assert np.isfinite(found.points_in_world).all() and np.isfinite(found.rig_from_world).all()


def surveyed_ring(rng, sigma: float, num: int = 5):
    """A ring with measured positions of its first points, and one more point that is checked; truth and problem."""
    truth, start = ring(rng)
    rows = np.arange(num + 1)
    error = sigma * rng.normal(size=(num + 1, 3))
    sigmas = np.full((num + 1, 3), sigma)
    sigmas[num] = np.inf
    points = PointPositions(rows, truth.points_in_world[rows] + error, sigmas)
    return truth, replace(start, priors=BundlePriors(points=points))


def test_measured_points_fix_position_orientation_and_scale():
    """Errors of a point without a measurement are as large as its covariance says."""
    sigma, squared = 0.05, []
    for seed in range(40):
        truth, problem = surveyed_ring(np.random.default_rng(seed), sigma)
        assert with_fixed_gauge(problem) is problem
        result = adjust_bundle(problem, EXACT)
        found = bundle_covariance(problem, result, noise_px=1.0)
        off = result.points_in_world[5] - truth.points_in_world[5]
        squared.append(off @ np.linalg.solve(found.points_in_world[5], off))
    assert 2.0 < np.mean(squared) < 4.2  # chi-squared with three degrees of freedom, standard error 0.39


def test_pixels_of_a_point_can_be_less_precise(rng):
    """Twice the standard deviation of all pixels: the minimum is the same, the cost a quarter, the variances four times."""
    _, start = ring(rng)
    problem = with_fixed_gauge(start)
    coarse = replace(problem, point_sigma_px=np.full(len(problem.point_free), 2.0))
    fine, other = adjust_bundle(problem, EXACT), adjust_bundle(coarse, EXACT)
    np.testing.assert_allclose(other.points_in_world, fine.points_in_world, atol=1e-6)
    np.testing.assert_allclose(4.0 * other.final_cost, fine.final_cost, rtol=1e-6)
    one, two = (bundle_covariance(p, r, noise_px=1.0) for p, r in ((problem, fine), (coarse, other)))
    np.testing.assert_allclose(two.rig_from_world, 4.0 * one.rig_from_world, rtol=1e-4)
    np.testing.assert_allclose(two.points_in_world, 4.0 * one.points_in_world, rtol=1e-4)


def test_no_more_residuals_than_unknowns_raises(rng):
    _, start = ring(rng, num_frames=5, num_points=1)
    with pytest.raises(DegenerateGeometryError, match="no more residuals"):
        bundle_covariance(start, adjust_bundle(start))


def test_what_took_no_part_does_not_count(rng):
    """An observation that was behind its camera at the start adds no knowledge, even where it would be seen now."""
    _, start = ring(rng)
    problem = with_fixed_gauge(start)
    result = adjust_bundle(problem, EXACT)
    without = result.used_mask.copy()
    without[: start.offsets[40]] = False
    fewer = bundle_covariance(problem, replace(result, used_mask=without), noise_px=1.0)
    every = bundle_covariance(problem, result, noise_px=1.0)
    moving = problem.frame_free.all(axis=1)
    assert (
        np.trace(fewer.rig_from_world, axis1=1, axis2=2)
        > 1.05 * np.trace(every.rig_from_world, axis1=1, axis2=2)
    )[moving].all()
    assert np.isinf(fewer.points_in_world[:40]).all()


def test_a_frame_all_of_whose_pixels_are_missing_is_not_known(rng):
    _, start = ring(rng)
    pixels = np.where((start.frame == 3)[:, None], np.nan, start.pixels)
    problem = with_fixed_gauge(replace(start, pixels=pixels))
    found = bundle_covariance(problem, adjust_bundle(problem, EXACT))
    assert np.isinf(found.rig_from_world[3]).all()
    assert np.isfinite(np.delete(found.rig_from_world, 3, axis=0)).all()
    assert np.isfinite(found.points_in_world).all()


def test_a_frame_with_two_observations_leaves_its_points_known(rng):
    """Its own place is open; what it sees is known from other frames, hardly better than without it."""
    _, start = ring(rng)
    of_frame = np.flatnonzero(start.frame == 3)
    pixels = start.pixels.copy()
    pixels[of_frame[2:]] = np.nan
    few = with_fixed_gauge(replace(start, pixels=pixels))
    found = bundle_covariance(few, adjust_bundle(few, EXACT), noise_px=1.0)
    none = with_fixed_gauge(
        replace(start, pixels=np.where((start.frame == 3)[:, None], np.nan, start.pixels))
    )
    without = bundle_covariance(none, adjust_bundle(none, EXACT), noise_px=1.0)
    assert np.isinf(found.rig_from_world[3]).all() and np.isfinite(found.points_in_world).all()
    np.testing.assert_allclose(found.points_in_world, without.points_in_world, rtol=0.02, atol=1e-5)
