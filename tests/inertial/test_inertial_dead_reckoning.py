"""The motion by an IMU alone: exact without noise, with an honest covariance, and refused where it cannot be known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial import (
    ImuBuffer,
    ImuCalibration,
    ImuLog,
    ImuNoise,
    MountedImu,
    align_path_to_imu,
    carry_motion,
    fit_imu_motion,
)
from epipole.synthetic.inertial import _Motion, inertial_path
from whole import IS_WHOLE

QUIET = ImuNoise(
    *(), gyro_density=1e-7, accel_density=1e-6, gyro_walk=1e-8, accel_walk=1e-7, accel_gain_sigma=1e-9
)
RATE_HZ, GAP_S = 30, 2.0


def seen_path(seed, seconds=11.0, position_sigma=3e-3, rotation_sigma=1e-3, noise=None):
    """The synthetic path, and its poses in meters at the rate of a camera: times, noisy poses and true ones."""
    path = inertial_path(seed, seconds=seconds, noise=noise)
    motion = _Motion(np.random.default_rng([17, seed]), is_even=False)
    times, rng = np.arange(0.2, seconds - 0.2, 1.0 / RATE_HZ), np.random.default_rng(seed)
    true = motion.position(times) @ path.camera_from_imu.inverse()
    off = Rotation3.exp(rotation_sigma * rng.normal(size=(len(times), 3))).matrix
    moved = true.translation + position_sigma * rng.normal(size=(len(times), 3))
    return path, times, Rigid3(true.rotation @ off, moved), true


def carried(seed, **options):
    """The pose after the gap by the IMU alone, its covariance, and the true pose."""
    path, times, poses, true = seen_path(seed, **options)
    last = len(times) - int(GAP_S * RATE_HZ) - 1
    keyframes, imu = np.arange(last % 8, last + 1, 8), path.imu()
    aligned = align_path_to_imu(times[keyframes], poses[keyframes], imu, is_metric=True)
    rows = np.arange(last - RATE_HZ + 1, last + 1)
    found = fit_imu_motion(times[rows], poses[rows], 1e-6 * np.eye(6), imu, aligned.calibration)
    pose, covariance = carry_motion(found, times[-1], imu).cam_from_world(path.camera_from_imu)
    return pose, covariance, true[len(times) - 1]


def test_two_seconds_without_images_cost_centimeters_and_the_covariance_says_so():
    errors, squares = [], []
    for seed in range(50 if IS_WHOLE else 12):
        pose, covariance, true = carried(seed)
        errors.append(np.linalg.norm(pose.inverse().translation - true.translation))
        xi = np.asarray((true.inverse() @ pose.inverse()).log())
        squares.append(xi @ np.linalg.solve(covariance, xi))
    assert np.median(errors) < 0.05
    assert max(errors) < 0.15
    assert 3.0 < np.mean(squares) < 10.0  # six on average


def test_without_noise_the_motion_is_exact():
    pose, covariance, true = carried(3, position_sigma=0.0, rotation_sigma=0.0, noise=QUIET)
    np.testing.assert_allclose(pose.inverse().translation, true.translation, atol=2e-3)
    np.testing.assert_allclose(pose.inverse().rotation, true.rotation, atol=1e-4)
    assert np.sqrt(covariance[3, 3]) < 2e-3


def test_the_covariance_grows_from_step_to_step_and_steps_are_one_step():
    path, times, poses, _ = seen_path(1)
    imu, rows = path.imu(), np.arange(40, 70)
    aligned = align_path_to_imu(times[::8], poses[::8], imu, is_metric=True)
    start = fit_imu_motion(times[rows], poses[rows], 1e-6 * np.eye(6), imu, aligned.calibration)
    at_once, step, sizes = carry_motion(start, times[100], imu), start, []
    for row in range(70, 101):
        step = carry_motion(step, times[row], imu)
        sizes.append(np.trace(step.cam_from_world(imu.camera_from_imu)[1][:3, :3]))
    assert (np.diff(sizes) > 0).all()
    np.testing.assert_allclose(step.world_from_imu.translation, at_once.world_from_imu.translation, atol=2e-4)
    pose = slice(0, 9)  # the bias's walk within a step is left out
    np.testing.assert_allclose(
        step.covariance[pose, pose], at_once.covariance[pose, pose], rtol=0.05, atol=1e-6
    )


@cache
def known_without_noise():
    """Times, poses, measurements and the calibration that they give, which no test changes."""
    path, times, poses, _ = seen_path(2, position_sigma=0.0, rotation_sigma=0.0, noise=QUIET)
    imu = path.imu()
    return times, poses, imu, align_path_to_imu(times[::8], poses[::8], imu, is_metric=True).calibration


@pytest.mark.parametrize("column", range(10))
def test_derivatives_by_the_calibration_are_those_of_the_motion(column):
    """Without other uncertainty, the covariance is that of the parameter alone."""
    times, poses, imu, known = known_without_noise()
    rows, step = np.arange(40, 70), 1e-4

    def end(calibration):
        start = fit_imu_motion(times[rows], poses[rows], np.zeros((6, 6)), imu, calibration)
        return carry_motion(start, times[90], imu).cam_from_world(imu.camera_from_imu)

    def moved(size):
        values = [known.scale, known.gravity_in_world.copy(), known.gyro_bias.copy(), known.accel_bias.copy()]
        if column < 6:
            values[2 + column // 3][column % 3] += size
        elif column == 6:
            values[0] *= np.exp(size)
        elif column == 7:
            values[1] = values[1] * np.exp(size)
        else:
            by = replace(known).gravity_by_calibration()[:, column - 7]
            axis = np.cross(values[1], by) / (values[1] @ values[1])
            values[1] = Rotation3.exp(size * axis).apply(values[1])
        return end(ImuCalibration(*values, np.zeros((10, 10))))[0]

    unit = np.zeros((10, 10))
    unit[column, column] = 1.0
    covariance = end(replace(known, covariance=unit))[1]
    xi = np.asarray((moved(step) @ moved(-step).inverse()).log()) / (2 * step)
    expected, alone = np.outer(xi, xi), end(replace(known, covariance=np.zeros((10, 10))))[1]
    np.testing.assert_allclose(covariance - alone, expected, rtol=0.03, atol=0.03 * np.abs(expected).max())


def test_misuse_is_refused():
    path, times, poses, _ = seen_path(0, seconds=5.0)
    imu = path.imu()
    known = align_path_to_imu(times[::8], poses[::8], imu, is_metric=True).calibration
    with pytest.raises(ShapeError, match="three times"):
        fit_imu_motion(times[:2], poses[:2], np.eye(6), imu, known)
    start = fit_imu_motion(times[:30], poses[:30], 1e-6 * np.eye(6), imu, known)
    with pytest.raises(ShapeError, match="increasing"):
        carry_motion(start, times[10], imu)
    with pytest.raises(DegenerateGeometryError, match="does not cover"):
        carry_motion(start, 100.0, imu)
    assert repr(known).startswith("ImuCalibration(scale ")


@pytest.mark.parametrize(("seed", "is_even"), [(0, True), (1, True), (2, False)])
def test_gravity_and_biases_of_a_trajectory_in_meters_do_not_need_acceleration(seed, is_even):
    path = inertial_path(seed, constant_velocity=is_even)
    meters = Rigid3(path.world_from_camera.rotation, path.scale * path.world_from_camera.translation)
    found = align_path_to_imu(path.timestamp_s, meters, path.imu(), is_metric=True)
    cosine = found.gravity_in_world @ path.gravity_in_world / 9.81 / np.linalg.norm(found.gravity_in_world)
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.3
    np.testing.assert_allclose(found.gyro_bias, path.gyro_bias, atol=1e-3)
    assert abs(found.scale - 1.0) < 0.04  # the accelerometer's gain


def test_gravity_is_known_at_rest(rng):
    times, gravity = np.arange(0.0, 8.0, 0.005), np.array([0.6, -9.79, 0.0])
    log = ImuLog(
        times, 1e-3 * rng.normal(size=(len(times), 3)), -gravity + 0.02 * rng.normal(size=(len(times), 3))
    )
    instants = np.arange(0.2, 7.8, 0.25)
    off = Rotation3.exp(1e-3 * rng.normal(size=(len(instants), 3))).matrix
    poses = Rigid3(off, 1e-3 * rng.normal(size=(len(instants), 3)))
    found = align_path_to_imu(instants, poses, MountedImu(log, Rigid3.identity()), is_metric=True)
    unit = found.gravity_in_world / np.linalg.norm(found.gravity_in_world)
    assert np.degrees(np.arccos(unit @ gravity / np.linalg.norm(gravity))) < 0.1
    with pytest.raises(DegenerateGeometryError):
        align_path_to_imu(instants, poses, MountedImu(log, Rigid3.identity()))


def test_a_log_is_cut_and_held_for_a_moment():
    times = 0.01 * np.arange(100)
    log = ImuLog(times, np.arange(300.0).reshape(-1, 3), np.ones((100, 3)))
    part = log.between(0.205, 0.295)
    assert part.timestamp_s[0] == pytest.approx(0.2)
    assert part.timestamp_s[-1] == pytest.approx(0.3)
    held = log.between(0.9, 1.02)
    assert held.timestamp_s[-1] == 1.02 and (held.gyro_rad_s[-1] == log.gyro_rad_s[-1]).all()
    assert log.between(0.9, 1.2).timestamp_s[-1] == times[-1]
    assert len(log.between(5.0, 6.0)) <= 1 and len(log.between(-2.0, -1.0)) <= 1


def test_a_buffer_grows_and_keeps_what_it_gave(rng):
    times = np.sort(rng.random(5000))
    whole = ImuLog(times, rng.normal(size=(5000, 3)), rng.normal(size=(5000, 3)), ("said",))
    buffer = ImuBuffer(ImuLog(times[:0], np.zeros((0, 3)), np.zeros((0, 3)), ("said",)))
    kept = []
    for start in range(0, 5000, 7):
        rows = slice(start, start + 7)
        buffer.add(ImuLog(times[rows], whole.gyro_rad_s[rows], whole.accel_m_s2[rows]))
        kept.append(buffer.log)
    for log in (kept[3], kept[200], kept[-1]):
        count = len(log)
        np.testing.assert_array_equal(log.timestamp_s, times[:count])
        np.testing.assert_array_equal(log.gyro_rad_s, whole.gyro_rad_s[:count])
        np.testing.assert_array_equal(log.accel_m_s2, whole.accel_m_s2[:count])
    assert buffer.log.notes == ("said",) and repr(buffer.log) == repr(whole)
    with pytest.raises(ShapeError, match="must increase"):
        buffer.add(ImuLog(times[:1], np.zeros((1, 3)), np.zeros((1, 3))))
