"""An IMU's factors between poses: derivatives, what they leave open, and what they give an adjustment."""

from dataclasses import replace

import numpy as np
import pytest

from epipole.errors import ShapeError
from epipole.geometry import Rigid3, align_points
from epipole.inertial import ImuNoise, align_path_to_imu, imu_factors
from epipole.optim import (
    BundlePriors,
    BundleProblem,
    adjust_bundle,
    bundle_variance,
    with_fixed_gauge,
    with_result,
)
from epipole.synthetic.inertial import imu_along, imu_and_biases_along, inertial_path
from whole import IS_WHOLE

QUIET = ImuNoise(accel_gain_sigma=1e-6)


def factors_of(path, poses, weight=1.0):
    imu = path.imu()
    aligned = align_path_to_imu(path.timestamp_s, poses, imu)
    return imu_factors(np.arange(len(path.timestamp_s)), path.timestamp_s, poses, imu, aligned, weight)


@pytest.fixture(scope="module")
def given():
    path = inertial_path(0, seconds=6.0)
    return path, factors_of(path, path.world_from_camera, weight=0.3)


def test_the_gradient_is_that_of_the_cost_at_the_best_of_all_else(given):
    path, factors = given
    poses = path.world_from_camera.inverse()
    _, gradient, matrix = factors.linearized(poses)
    step, numeric = 1e-5, np.zeros((3, 6))
    for row, frame in enumerate((0, 7, 20)):
        for k in range(6):
            xi = np.zeros((len(gradient), 6))
            xi[frame, k] = step
            ends = [factors.linearized(Rigid3.exp(s * xi) @ poses)[0] for s in (1.0, -1.0)]
            numeric[row, k] = (ends[0] - ends[1]) / (2 * step)
    np.testing.assert_allclose(numeric, gradient[[0, 7, 20]], atol=1e-6 * np.abs(gradient).max())
    whole = matrix.reshape(gradient.size, gradient.size)
    assert (np.linalg.eigvalsh(whole) > -1e-9 * np.abs(whole).max()).all()


def test_place_turn_and_scale_of_the_whole_path_are_left_open(given):
    path, factors = given
    poses = path.world_from_camera
    cost = factors.linearized(poses.inverse())[0]
    rotated = Rigid3.exp(np.array([3.0, -2.0, 1.0, 0.4, -0.9, 0.3])) @ poses
    assert factors.linearized(rotated.inverse())[0] == pytest.approx(cost, rel=1e-6)
    larger = Rigid3(poses.rotation, 1.3 * poses.translation)
    assert factors.linearized(larger.inverse())[0] == pytest.approx(cost, rel=1e-6)
    found = [factors.scale(one.inverse())[0] for one in (poses, larger)]
    assert found[1] - found[0] == pytest.approx(-np.log(1.3), abs=1e-6)


def seen_scene(path, rng, noise_px, num_new=12):
    """A camera that sees points in four or five frames each, so that its path drifts."""
    cams, n = path.world_from_camera.inverse(), len(path.timestamp_s)
    frame, point, pixels, points = [], [], [], []
    for i in range(n):
        uv = rng.uniform([0, 0], [640, 480], (num_new, 2))
        rays = np.column_stack([(uv - [320, 240]) / 300, np.ones(num_new)])
        far = rng.uniform(2, 6, num_new)[:, None] / path.scale
        there = path.world_from_camera[np.full(num_new, i)].apply(rays * far)
        for j in range(max(0, i - 2), min(n, i + 3)):
            at = cams[np.full(num_new, j)].apply(there)
            uv = at[:, :2] / at[:, 2:] * 300 + [320, 240]
            inside = np.flatnonzero((at[:, 2] > 0.1) & (uv > 0).all(axis=1) & (uv < [640, 480]).all(axis=1))
            frame += [j] * len(inside)
            point += (len(points) + inside).tolist()
            pixels += (uv[inside] + noise_px * rng.normal(size=(len(inside), 2))).tolist()
        points += there.tolist()
    kept = np.bincount(point)[point] >= 2
    rows, local = np.unique(np.array(point)[kept], return_inverse=True)
    order = np.argsort(local, kind="stable")
    none = np.zeros(len(order), np.int32)
    params = np.zeros((1, 12))
    params[0, :4] = 300.0, 300.0, 320.0, 240.0
    return with_fixed_gauge(
        BundleProblem(
            *(cams, Rigid3.identity(1), np.array([1], np.int32), params, np.array(points)[rows]),
            np.concatenate([[0], np.cumsum(np.bincount(local))]).astype(np.int64),
            *(np.array(frame, np.int32)[kept][order], none, none, np.array(pixels)[kept][order]),
            *(np.ones((n, 6)), np.zeros((1, 12)), np.ones(len(rows))),
        )
    )


def error_of(path, found):
    """Root mean square error of places in meters, and meters of the found path's unit."""
    there = path.world_from_camera.translation
    fit = align_points(found.translation, there)
    off = fit.apply(found.translation) - there
    return path.scale * np.sqrt((off**2).sum(axis=1).mean()), path.scale * float(fit.scale)


def test_an_adjustment_with_them_is_nearer_the_truth_and_tells_its_scale():
    before, after, z = [], [], []
    for seed in range(6 if IS_WHOLE else 3):
        path = inertial_path(seed, seconds=12.0, position_sigma_m=0.0, rotation_sigma_rad=0.0, noise=QUIET)
        problem = seen_scene(path, np.random.default_rng(seed), noise_px=0.7)
        seen = adjust_bundle(problem)
        factors = factors_of(path, seen.rig_from_world.inverse(), weight=0.7**2)
        problem = replace(with_result(problem, seen), priors=BundlePriors(paths=(factors,)))
        both = adjust_bundle(problem)
        before.append(error_of(path, seen.rig_from_world.inverse())[0])
        error, unit = error_of(path, both.rig_from_world.inverse())
        after.append(error)
        given, own, derivative = factors.scale(both.rig_from_world)
        sigma = np.sqrt(own + 0.7**2 * bundle_variance(problem, both, derivative))
        z.append((given - np.log(unit)) / sigma)
        gyro, accel = factors.variance_factors(both.rig_from_world)
        assert gyro < 2.0 and accel < 2.0  # as stated: poses that are weakly seen follow the unit
    assert np.median(after) < 0.6 * np.median(before)
    assert np.abs(z).max() < 3 and np.sqrt(np.mean(np.square(z))) < 1.7


def test_a_unit_along_a_path_measures_its_motion():
    times = np.linspace(0.0, 6.0, 60)
    xi = np.column_stack([np.sin(times), np.cos(1.3 * times), 0.1 * times, *np.zeros((2, 60)), 0.5 * times])
    exact = ImuNoise(gyro_density=1e-9, accel_density=1e-9, accel_gain_sigma=1e-9)
    log, gyro_bias, accel_bias = imu_and_biases_along(times, Rigid3.exp(xi), Rigid3.identity(), 0, exact)
    np.testing.assert_allclose(np.diff(log.gyro_rad_s, axis=0), 0.0, atol=1e-4)
    inside = (log.timestamp_s > 1.0) & (log.timestamp_s < 5.0)  # splines end with another curvature
    np.testing.assert_allclose(
        (log.gyro_rad_s - gyro_bias)[inside], [[0.0, 0.0, 0.5]] * inside.sum(), atol=1e-3
    )
    other, _, other_bias = imu_and_biases_along(times, Rigid3.exp(xi), Rigid3.identity(), 1, exact)
    np.testing.assert_allclose(log.accel_m_s2 - accel_bias, other.accel_m_s2 - other_bias, atol=1e-6)
    assert np.abs(accel_bias - other_bias).max() > 0.01
    with pytest.raises(ShapeError, match="four"):
        imu_along(times[:3], Rigid3.exp(xi[:3]), Rigid3.identity(), 0)
    with pytest.raises(ShapeError, match="increase"):
        imu_along(times[::-1].copy(), Rigid3.exp(xi), Rigid3.identity(), 0)
