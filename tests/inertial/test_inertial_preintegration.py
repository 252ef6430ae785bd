"""Pre-integration against a motion that is known, its derivative by the biases, and its covariance against many draws."""

import numpy as np
import pytest

from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rotation3
from epipole.inertial import ImuLog, ImuNoise, preintegrate

TIMES = np.arange(0.0, 3.0, 0.005)
INSTANTS = np.arange(0.1013, 2.8, 0.317)  # between samples
GRAVITY = np.array([0.0, 0.0, -9.81])
STEP = 1e-4


def position(t):
    return np.stack([np.sin(t), 0.7 * np.cos(1.3 * t), 0.3 * np.sin(0.8 * t + 1)], axis=-1)


def rotated(t):
    return Rotation3.exp(np.stack([0.4 * np.sin(0.9 * t), 0.3 * np.cos(1.1 * t), 0.15 * t], axis=-1))


@pytest.fixture(scope="module")
def log():
    pulled = (position(TIMES + STEP) - 2 * position(TIMES) + position(TIMES - STEP)) / STEP**2
    rotating = (rotated(TIMES - STEP).inverse() @ rotated(TIMES + STEP)).log() / (2 * STEP)
    return ImuLog(TIMES, rotating, rotated(TIMES).inverse().apply(pulled - GRAVITY))


def test_what_is_integrated_is_the_motion_without_gravity(log):
    found = preintegrate(log, INSTANTS)
    speed = (position(INSTANTS + STEP) - position(INSTANTS - STEP)) / (2 * STEP)
    dt, back = np.diff(INSTANTS)[:, None], rotated(INSTANTS[:-1]).inverse()
    off = Rotation3(found.rotation).inverse() @ back @ rotated(INSTANTS[1:])
    assert np.abs(off.log()).max() < 1e-6
    np.testing.assert_allclose(back.apply(np.diff(speed, axis=0) - GRAVITY * dt), found.velocity, atol=5e-6)
    went = np.diff(position(INSTANTS), axis=0) - speed[:-1] * dt - 0.5 * GRAVITY * dt**2
    np.testing.assert_allclose(back.apply(went), found.position, atol=5e-6)
    np.testing.assert_allclose(found.seconds, dt[:, 0])


def test_a_change_of_the_biases_is_followed_to_first_order(log):
    bias = np.array([0.02, -0.03, 0.01, 0.1, -0.2, 0.15])
    plain, exact = preintegrate(log, INSTANTS), preintegrate(log, INSTANTS, bias[:3], bias[3:])
    rotation, velocity, position = plain.at_biases(np.tile(bias, (len(INSTANTS) - 1, 1)))
    for first, true, zero in (
        (velocity, exact.velocity, plain.velocity),
        (position, exact.position, plain.position),
    ):
        assert np.abs(first - true).max() < 0.01 * np.abs(zero - true).max()
    assert np.abs((Rotation3(exact.rotation).inverse() @ Rotation3(rotation)).log()).max() < 1e-5


def test_the_covariance_is_that_of_many_draws(log, rng):
    noise = ImuNoise(gyro_density=2e-3, accel_density=2e-2)
    rate = np.sqrt(200.0)
    true, rendered = preintegrate(log, INSTANTS, noise=noise), []
    for _ in range(150):
        gyro = log.gyro_rad_s + rate * noise.gyro_density * rng.normal(size=(len(TIMES), 3))
        accel = log.accel_m_s2 + rate * noise.accel_density * rng.normal(size=(len(TIMES), 3))
        one = preintegrate(ImuLog(TIMES, gyro, accel), INSTANTS)
        off = (Rotation3(true.rotation).inverse() @ Rotation3(one.rotation)).log()
        rendered.append(
            np.concatenate([off, one.velocity - true.velocity, one.position - true.position], axis=1)
        )
    root = np.linalg.inv(np.linalg.cholesky(true.covariance))
    white = np.einsum("mij,smj->smi", root, np.array(rendered))
    spread = np.einsum("smi,smj->ij", white, white) / (white.shape[0] * white.shape[1])
    np.testing.assert_allclose(spread, np.eye(9), atol=0.12)  # 1200 draws: 3 sigma of a variance


def test_what_the_log_does_not_cover_is_refused(log):
    with pytest.raises(DegenerateGeometryError, match="does not cover"):
        preintegrate(log, np.array([1.0, 4.0]))
    gap = (TIMES < 1.0) | (TIMES > 1.4)
    torn = ImuLog(TIMES[gap], log.gyro_rad_s[gap], log.accel_m_s2[gap])
    with pytest.raises(DegenerateGeometryError, match=r"gap of 0\.4"):
        preintegrate(torn, np.array([0.5, 2.0]))
    with pytest.raises(ShapeError, match="increasing times"):
        preintegrate(log, np.array([2.0, 1.0]))
    with pytest.raises(ShapeError, match="must increase"):
        ImuLog(TIMES[::-1].copy(), log.gyro_rad_s, log.accel_m_s2)
    with pytest.raises(ConfigError, match="gyro_walk"):
        ImuNoise(gyro_walk=0.0)
    with pytest.raises(ConfigError, match="accel_gain_sigma must be positive and below"):
        ImuNoise(accel_gain_sigma=1e308)
