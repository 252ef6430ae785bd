"""Odometry: the scale of a path from distances, robust against slip."""

import numpy as np
import pytest

from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.scale import agreed_scale, fit_scale_to_distances

TIMES = np.linspace(0.0, 30.0, 301)
WAY = np.stack([6 * np.cos(0.2 * TIMES), 4 * np.sin(0.2 * TIMES), 0.1 * np.sin(TIMES)], axis=1)
STEPS = np.linalg.norm(np.diff(WAY, axis=0), axis=1)


def traveled(rng, fraction=0.0, scatter=0.02):
    steps = STEPS * (1 + fraction) * (1 + scatter * rng.standard_normal(len(STEPS)))
    return np.concatenate([[0.0], np.cumsum(steps)])


def model(rng, unit=2.0, jitter=0.003):
    return (WAY + jitter * rng.standard_normal(WAY.shape)) / unit


def test_the_true_scale_lies_within_what_is_stated(rng):
    away = []
    for _ in range(100):
        wheels = traveled(rng, 0.01 * rng.normal())
        found = fit_scale_to_distances(TIMES, model(rng), TIMES, wheels, None, 0.01)
        away.append((found.scale / 2.0 - 1.0) / found.fraction)
    assert 0.7 < np.std(away) < 1.2 and (np.abs(away) < 2).mean() >= 0.9


def test_slip_does_not_count(rng):
    steps = np.diff(traveled(rng))
    steps[60:110] *= 2.0
    wheels = np.concatenate([[0.0], np.cumsum(steps)])
    found = fit_scale_to_distances(TIMES, model(rng), TIMES, wheels, None, 0.0)
    assert found.scale == pytest.approx(2.0, rel=0.01)
    assert "segments agree" in found.note


def test_places_by_odometry_are_compared_over_stretches(rng):
    drifting = WAY * 1.005 + np.cumsum(0.001 * rng.standard_normal(WAY.shape), axis=0) + [100.0, 5, 0]
    found = fit_scale_to_distances(TIMES, model(rng), TIMES[::3], None, drifting[::3], 0.01)
    assert found.scale == pytest.approx(2.0, abs=3 * found.fraction * 2.0)


def test_too_little_is_refused(rng):
    wheels, positions = traveled(rng), model(rng)
    with pytest.raises(DegenerateGeometryError, match="did not move while"):
        fit_scale_to_distances(TIMES, positions, TIMES, 0 * wheels, None, 0.01)
    with pytest.raises(DegenerateGeometryError, match="0 posed images"):
        fit_scale_to_distances(TIMES, positions, TIMES + 100, wheels, None, 0.01)
    with pytest.raises(DegenerateGeometryError, match="0 posed images"):
        fit_scale_to_distances(TIMES, positions, np.zeros(0), np.zeros(0), None, 0.01)
    spinning = np.cumsum(np.repeat(np.exp(1.5 * rng.standard_normal(43)), 7))
    lost = fit_scale_to_distances(TIMES, positions, TIMES, spinning, None, 0.01)
    with pytest.raises(DegenerateGeometryError, match="too uncertain"):
        agreed_scale([lost])
    with pytest.raises(ConfigError, match="sigma must be a fraction"):
        fit_scale_to_distances(TIMES, positions, TIMES, wheels, None, 1.5)
    with pytest.raises(ShapeError, match="exactly one of"):
        fit_scale_to_distances(TIMES, positions, TIMES, wheels, positions, 0.01)


AHEAD = 0.5


def drive(rng, num=600, *, spin=False):
    """A robot that turns to and fro, or also on the spot, with its camera half a meter ahead of the middle of its wheels.

    Returns:
        Times, places of the wheels' middle, levers from the camera to it, and the way of the wheels.
    """
    times, step = 0.1 * np.arange(num), 0.05
    rotation = 1.4 * np.sin(2.1 * step * np.arange(num)) + 0.4 * np.cumsum(0.1 * rng.standard_normal(num))
    steps = np.full(num - 1, step)
    if spin:
        resting = np.arange(num - 1) % 60 < 12
        steps[resting], rotation = 0.0, rotation + 0.15 * np.cumsum([0, *resting])
    ahead = np.stack([np.cos(rotation), np.sin(rotation), 0 * rotation], axis=1)
    trajectory = np.concatenate([[0.0], np.cumsum(steps)])
    wheels = np.concatenate(
        [np.zeros((1, 3)), np.cumsum(steps[:, None] * (ahead[1:] + ahead[:-1]) / 2, axis=0)]
    )
    return times, wheels, -AHEAD * ahead, trajectory


@pytest.mark.parametrize("kind", ["distances", "places"])
def test_a_camera_ahead_of_the_wheels(rng, kind):
    """Without the mounting the scale is wrong by per cent; with it the truth lies within what is stated."""
    away, without = [], []
    for _ in range(60):
        times, wheels, levers, trajectory = drive(rng)
        positions = (wheels - levers + 0.002 * rng.standard_normal(wheels.shape)) / 2.0
        unit = 1 + 0.01 * rng.normal()
        steps = np.diff(trajectory) * unit * (1 + 0.02 * rng.standard_normal(len(times) - 1))
        traveled = np.concatenate([[0.0], np.cumsum(steps)]) if kind == "distances" else None
        there = wheels * unit if kind == "places" else None
        known = (times, positions, times, traveled, there, 0.01)
        found = fit_scale_to_distances(*known, levers)
        away.append((found.scale / 2.0 - 1.0) / found.fraction)
        without.append(fit_scale_to_distances(*known).scale / 2.0 - 1.0)
    assert 0.6 < np.std(away) < 1.3 and (np.abs(away) < 2).mean() >= 0.9
    assert np.mean(without) < -0.03 if kind == "distances" else np.abs(without).mean() > 0.02


@pytest.mark.parametrize("factor", [1.0, 0.3])
def test_turns_on_the_spot(rng, factor):
    """The camera goes round the wheels while they stand still; distances are exact, and so is the scale."""
    times, wheels, levers, trajectory = drive(rng, spin=True)
    positions = factor * (wheels - levers)
    found = fit_scale_to_distances(times, positions, times, trajectory, None, 0.01, levers)
    assert found.scale * factor == pytest.approx(1.0, rel=0.005)
    assert (
        abs(fit_scale_to_distances(times, positions, times, trajectory, None, 0.01).scale * factor - 1.0)
        > 0.1
    )


def test_slip_with_a_mounting(rng):
    times, wheels, levers, trajectory = drive(rng)
    steps = np.diff(trajectory)
    steps[100:180] *= 1.6
    slipped = np.concatenate([[0.0], np.cumsum(steps)])
    found = fit_scale_to_distances(times, (wheels - levers) / 3, times, slipped, None, 0.0, levers)
    assert found.scale == pytest.approx(3.0, rel=0.01)


def test_a_mounting_that_tells_no_scale(rng):
    angle = 0.05 * np.arange(200)
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    times, trajectory = 0.1 * np.arange(200), 0.3 * angle
    with pytest.raises(DegenerateGeometryError, match=r"two scales fit with this mounting, 4 and (1|0\.999)"):
        # The wheels go round a circle of 0.3 m, the camera half a meter inward of them, on its other side.
        fit_scale_to_distances(times, -0.2 * around, times, trajectory, None, 0.01, 0.5 * around)
    with pytest.raises(DegenerateGeometryError, match="did not move while"):
        fit_scale_to_distances(times, 0 * around, times, trajectory, None, 0.01, 0.3 * around)
    with pytest.raises(DegenerateGeometryError, match="no scale makes the trajectory"):
        fit_scale_to_distances(
            times, np.roll(around, 1, axis=1), times, 0.01 * trajectory, None, 0.01, 2.0 * around
        )
    with pytest.raises(ShapeError, match="finite"):
        fit_scale_to_distances(times, around, times, trajectory, None, 0.01, np.nan * around)
