"""A path up to scale and an IMU: scale, gravity, biases and velocities with the deviation stated, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial import ImuLog, ImuNoise, MountedImu, align_path_to_imu, preintegrate
from epipole.inertial._inertial_problem import InertialProblem, States
from epipole.io.sequences.imu_logs import read_camera_from_imu, read_imu
from epipole.scale import fit_scale_to_imu
from epipole.synthetic.inertial import InertialPath, inertial_path
from whole import IS_WHOLE, in_whole_run


def aligned(path: InertialPath, **options):
    return align_path_to_imu(path.timestamp_s, path.world_from_camera, path.imu(), **options)


@pytest.mark.parametrize("seed", range(3 if IS_WHOLE else 1))
def test_scale_gravity_and_biases_are_found(seed):
    path = inertial_path(seed)
    found = aligned(path)
    assert abs(found.scale - path.scale) < 3 * found.sigma and found.sigma < 0.015 * path.scale
    cosine = found.gravity_in_world @ path.gravity_in_world / 9.81**2
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.3
    np.testing.assert_allclose(found.gyro_bias, path.gyro_bias, atol=1e-3)
    np.testing.assert_allclose(found.velocity_in_world, path.velocity_in_world, atol=0.06)
    assert 0.7 < found.misfit < 4


@pytest.mark.parametrize("seed", [2] + IS_WHOLE * [0])
def test_constant_velocity_names_no_meter(seed):
    with pytest.raises(DegenerateGeometryError, match="constant velocity"):
        aligned(inertial_path(seed, seconds=6.0, constant_velocity=True))


@in_whole_run
def test_scale_and_biases_are_within_their_deviations_although_the_gain_is_unknown():
    """A gain error of 1 % changes the accelerometer's reading by 0.1 m / s^2 along gravity, as much as the biases do."""
    over_sigma, of_scale = [], []
    for seed in range(12):
        motion = inertial_path(seed, 8.0)
        found = align_path_to_imu(motion.timestamp_s, motion.world_from_camera, motion.imu())
        off = found.accel_bias - motion.accel_bias
        over_sigma.append(np.abs(off) / np.sqrt(np.diag(found.calibration.covariance)[3:6]))
        of_scale.append((found.scale - motion.scale) / found.sigma)
    assert (np.array(over_sigma) <= 2.0).mean() > 0.85
    assert np.sqrt(np.mean(np.square(of_scale))) < 1.5


@pytest.mark.parametrize("is_metric", [False, True])
def test_a_gain_error_does_not_tilt_gravity(is_metric):
    """An accelerometer that reads 4 % too much: rotations separate its gain along gravity from its biases."""
    path = inertial_path(1)
    log = replace(path.log, accel_m_s2=1.04 * path.log.accel_m_s2)
    unsure = replace(path.imu(), log=log, noise=replace(path.imu().noise, accel_gain_sigma=0.04))
    poses = path.world_from_camera
    if is_metric:
        poses = Rigid3(poses.rotation, path.scale * poses.translation)
    found = align_path_to_imu(path.timestamp_s, poses, unsure, is_metric=is_metric)
    assert np.linalg.norm(found.gravity_in_world) == pytest.approx(9.81)
    assert np.degrees(np.arccos(found.gravity_in_world @ path.gravity_in_world / 9.81**2)) < 0.15
    assert np.linalg.norm(found.calibration.gravity_in_world) / 9.81 == pytest.approx(1.04, abs=0.02)
    sigma = np.sqrt(np.diag(found.calibration.covariance)[3:6])
    assert (np.abs(found.accel_bias - 1.04 * path.accel_bias) < 3.5 * sigma).all()
    assert abs(found.scale - (1.0 if is_metric else path.scale)) < 2 * 0.04 * found.scale


def test_without_noise_the_scale_is_exact():
    quiet = ImuNoise(
        *(), gyro_density=1e-7, accel_density=1e-6, gyro_walk=1e-8, accel_walk=1e-7, accel_gain_sigma=1e-9
    )
    path = inertial_path(3, position_sigma_m=0.0, rotation_sigma_rad=0.0, noise=quiet)
    assert aligned(path).scale == pytest.approx(path.scale, rel=2e-4)


def test_another_units_log_is_refused():
    path, other = inertial_path(0), inertial_path(1)
    with pytest.raises(DegenerateGeometryError):
        align_path_to_imu(path.timestamp_s, path.world_from_camera, replace(path.imu(), log=other.log))
    still = Rigid3(path.world_from_camera.rotation, np.zeros_like(path.world_from_camera.translation))
    with pytest.raises(DegenerateGeometryError, match="does not move"):
        align_path_to_imu(path.timestamp_s, still, path.imu())
    with pytest.raises(DegenerateGeometryError, match="8 are needed"):
        align_path_to_imu(path.timestamp_s[:5], path.world_from_camera[:5], path.imu())
    rows = np.zeros(250, np.int64)
    with pytest.raises(ConfigError, match="250 poses"):
        align_path_to_imu(np.arange(250) * 0.05, path.world_from_camera[rows], path.imu())
    with pytest.raises(ShapeError, match="times"):
        align_path_to_imu(path.timestamp_s[:5], path.world_from_camera, path.imu())
    for mounting in (Rigid3(np.full((3, 3), np.nan), np.zeros(3)), Rigid3(np.eye(3), np.full(3, np.inf))):
        with pytest.raises(ShapeError, match="camera_from_imu must be finite"):
            align_path_to_imu(
                path.timestamp_s, path.world_from_camera, replace(path.imu(), camera_from_imu=mounting)
            )


@pytest.mark.parametrize("is_metric", [False, True])
def test_derivatives_are_those_of_the_terms(rng, is_metric):
    path = inertial_path(2, seconds=4.0)
    measured = preintegrate(path.log, path.timestamp_s)
    unit = path.world_from_camera @ path.camera_from_imu
    n = len(unit.translation)
    states = States(
        *(unit.rotation, rng.normal(size=(n, 3)), unit.translation, 1e-3 * rng.normal(size=(n, 6))),
        *(0.2, path.gravity_in_world),
    )
    poses, mounting, sigmas = path.world_from_camera, path.camera_from_imu, (0.01, 0.01)
    problem = InertialProblem(measured, poses, mounting, ImuNoise(), sigmas, np.zeros(3), is_metric)
    states = problem.moved(states, 1e-3 * rng.normal(size=problem.num_unknowns))
    _, gradient = problem.normal_equations(states)
    for _ in range(3):
        trajectory = rng.normal(size=len(gradient))
        ahead, behind = (problem.cost(problem.moved(states, h * trajectory)) for h in (1e-6, -1e-6))
        assert (ahead - behind) / 2e-6 == pytest.approx(gradient @ trajectory, rel=2e-3)


def test_stretches_give_one_scale_and_what_drifts_is_told_by_the_deviation():
    path = inertial_path(4, seconds=26.0)
    found = fit_scale_to_imu(path.timestamp_s, path.world_from_camera, path.imu())
    assert found.note == "the IMU (2 of 2 segments)" and found.shared_sigma == 0.01
    assert abs(found.scale / path.scale - 1) < 2 * found.fraction < 0.03
    with pytest.raises(DegenerateGeometryError, match="no 12 consecutive poses"):
        fit_scale_to_imu(path.timestamp_s + 900.0, path.world_from_camera, path.imu())


@in_whole_run
def test_a_real_unit_on_a_drone_with_its_true_path(data_dir):
    """EuRoC V1_01: sensitivity, vibration and clock as they are; the truth is the path by a laser tracker's motion capture."""
    log, noise = read_imu(data_dir / "slam" / "euroc_static" / "mav0" / "imu0")
    imu = MountedImu(log, Rigid3.identity(), noise)
    assert noise.accel_walk == 3e-3 and len(log) == 29120
    rows = np.loadtxt(data_dir / "slam" / "euroc_static" / "V1_01_easy.csv", delimiter=",")[:1200:5]
    times = rows[:, 0] * 1e-9
    inside = (times > log.timestamp_s[0]) & (times < log.timestamp_s[-1])
    rows, times = rows[inside], times[inside]
    path = Rigid3(Rotation3.from_quat_wxyz(rows[:, 4:8]).matrix, rows[:, 1:4] / 2.5)
    found = fit_scale_to_imu(times, path, imu)
    assert abs(found.scale / 2.5 - 1) < min(2 * found.fraction, 0.02)
    few = slice(0, 60)
    one = align_path_to_imu(times[few], path[few], imu)
    np.testing.assert_allclose(one.gyro_bias, rows[few, 11:14].mean(axis=0), atol=2e-3)
    assert np.degrees(np.arccos(-one.gravity_in_world[2] / 9.81)) < 1.0
    mounting = read_camera_from_imu(data_dir / "slam" / "euroc_static" / "mav0" / "cam0" / "sensor.yaml")
    assert 0.05 < np.linalg.norm(mounting.translation) < 0.1


def test_a_log_is_sorted_out(tmp_path):
    table = tmp_path / "imu.txt"
    table.write_text("# s\n0.0 0 0 0 0 0 9.8\n0.1,0,0,0,0,0,9.8\n")
    log, noise = read_imu(table)
    assert np.array_equal(log.timestamp_s, [0.0, 0.1]) and noise == ImuNoise()
    assert replace(noise, accel_walk=1.0) != noise and repr(log) == "ImuLog(2 samples, 0.1 s, 10 Hz)"
    assert isinstance(log, ImuLog)
