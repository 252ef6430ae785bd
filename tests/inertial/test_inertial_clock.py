"""The clock offset between a camera and an IMU, and the mounting's rotation: found with their deviation, or refused."""

from dataclasses import replace

import numpy as np
import pytest

from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial import ImuLog, MountedImu, fit_imu_clock
from epipole.synthetic.inertial import _Motion, inertial_path
from whole import IS_WHOLE


def seen(seed, offset_s, off_deg=3.0, seconds=10.0):
    """Times and poses by a camera whose clock is behind the IMU's, the IMU with a wrong mounting, and the true one."""
    path, rng = inertial_path(seed, seconds=seconds), np.random.default_rng(seed)
    motion = _Motion(np.random.default_rng([17, seed]), is_even=False)
    times = np.arange(0.5, seconds - 0.5, 1.0 / 15.0)
    true = motion.position(times + offset_s) @ path.camera_from_imu.inverse()
    noise = Rotation3.exp(1e-3 * rng.normal(size=(len(times), 3))).matrix
    poses = Rigid3(true.rotation @ noise, 0.3 * true.translation)  # up to scale
    given = Rotation3.exp(np.radians(off_deg) * rng.normal(size=3)).matrix @ path.camera_from_imu.rotation
    mounting = Rigid3(given, path.camera_from_imu.translation)
    return times, poses, replace(path.imu(), camera_from_imu=mounting), path.camera_from_imu


def test_offset_and_rotation_are_found_within_their_deviations_or_refused():
    num_found, squares, tries = 0, [], 50 if IS_WHOLE else 12
    for seed in range(tries):
        offset = np.random.default_rng([3, seed]).uniform(-0.1, 0.1)
        times, poses, imu, mounting = seen(seed, offset)
        try:
            found = fit_imu_clock(times, poses, imu)
        except DegenerateGeometryError:
            continue
        num_found += 1
        assert abs(found.offset_s - offset) < min(3e-3, 3.0 * found.offset_sigma_s)
        phi = np.asarray(Rotation3(mounting.rotation @ found.rotation.T).log())
        squares.append(phi @ np.linalg.solve(found.rotation_covariance, phi))
        assert found.num_rotations > 30 and "ImuClock(offset" in repr(found)
    assert num_found >= 0.5 * tries
    assert 0.5 < np.mean(squares) < 4.0  # three on average if the errors of rotations were independent


def test_rest_and_even_rotation_do_not_show_it():
    times, poses, imu, _ = seen(0, 0.05)
    still = Rigid3(np.tile(poses.rotation[:1], (len(times), 1, 1)), poses.translation)
    level = ImuLog(imu.log.timestamp_s, 1e-3 * np.ones((len(imu.log), 3)), imu.log.accel_m_s2)
    with pytest.raises(DegenerateGeometryError, match="does not show"):
        fit_imu_clock(times, still, replace(imu, log=level))
    even = ImuLog(imu.log.timestamp_s, np.tile([0.0, 0.3, 0.0], (len(imu.log), 1)), imu.log.accel_m_s2)
    mount = Rotation3(imu.camera_from_imu.rotation)
    spun = Rotation3.exp(np.outer(0.3 * times, [0.0, 1.0, 0.0]))
    rotations = spun.matrix @ mount.matrix.T
    with pytest.raises(DegenerateGeometryError, match="does not show"):
        fit_imu_clock(times, Rigid3(rotations, poses.translation), replace(imu, log=even))


def test_another_log_and_misuse_are_refused():
    times, poses, imu, _ = seen(0, 0.0)
    with pytest.raises(DegenerateGeometryError):
        fit_imu_clock(times, poses, replace(imu, log=inertial_path(7).log))
    with pytest.raises(DegenerateGeometryError, match="8 are needed"):
        fit_imu_clock(times + 1000.0, poses, imu)
    with pytest.raises(DegenerateGeometryError, match="8 are needed"):
        none = ImuLog(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
        fit_imu_clock(times, poses, MountedImu(none, imu.camera_from_imu))
    with pytest.raises(ShapeError, match="rows"):
        fit_imu_clock(times[1:], poses, imu)
    with pytest.raises(ShapeError, match="increase"):
        fit_imu_clock(times[::-1].copy(), poses, imu)
    with pytest.raises(ShapeError, match="finite"):
        fit_imu_clock(times, Rigid3(poses.rotation * np.nan, poses.translation), imu)
    with pytest.raises(ConfigError, match="largest_offset_s"):
        fit_imu_clock(times, poses, imu, 0.0)
