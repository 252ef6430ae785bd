"""Odometry: the scale of a path from distances, robust against slip."""

import numpy as np
import pytest

from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.mapping import agreed_scale, fit_scale_to_distances

TIMES = np.linspace(0.0, 30.0, 301)
WAY = np.stack([6 * np.cos(0.2 * TIMES), 4 * np.sin(0.2 * TIMES), 0.1 * np.sin(TIMES)], axis=1)
STEPS = np.linalg.norm(np.diff(WAY, axis=0), axis=1)


def travelled(rng, share=0.0, scatter=0.02):
    steps = STEPS * (1 + share) * (1 + scatter * rng.standard_normal(len(STEPS)))
    return np.concatenate([[0.0], np.cumsum(steps)])


def model(rng, unit=2.0, jitter=0.003):
    return (WAY + jitter * rng.standard_normal(WAY.shape)) / unit


def test_the_true_scale_lies_within_what_is_stated(rng):
    away = []
    for _ in range(100):
        wheels = travelled(rng, 0.01 * rng.normal())
        found = fit_scale_to_distances(TIMES, model(rng), TIMES, wheels, None, 0.01)
        away.append((found.scale / 2.0 - 1.0) / found.share)
    assert 0.7 < np.std(away) < 1.2 and (np.abs(away) < 2).mean() >= 0.9


def test_slip_does_not_count(rng):
    steps = np.diff(travelled(rng))
    steps[60:110] *= 2.0
    wheels = np.concatenate([[0.0], np.cumsum(steps)])
    found = fit_scale_to_distances(TIMES, model(rng), TIMES, wheels, None, 0.0)
    assert found.scale == pytest.approx(2.0, rel=0.01)
    assert "stretches agree" in found.note


def test_places_by_odometry_are_compared_over_stretches(rng):
    drifting = WAY * 1.005 + np.cumsum(0.001 * rng.standard_normal(WAY.shape), axis=0) + [100.0, 5, 0]
    found = fit_scale_to_distances(TIMES, model(rng), TIMES[::3], None, drifting[::3], 0.01)
    assert found.scale == pytest.approx(2.0, abs=3 * found.share * 2.0)


def test_too_little_is_refused(rng):
    wheels, places = travelled(rng), model(rng)
    with pytest.raises(DegenerateGeometryError, match="stood still"):
        fit_scale_to_distances(TIMES, places, TIMES, 0 * wheels, None, 0.01)
    with pytest.raises(DegenerateGeometryError, match="0 pictures"):
        fit_scale_to_distances(TIMES, places, TIMES + 100, wheels, None, 0.01)
    with pytest.raises(DegenerateGeometryError, match="0 pictures"):
        fit_scale_to_distances(TIMES, places, np.zeros(0), np.zeros(0), None, 0.01)
    spinning = np.cumsum(np.repeat(np.exp(1.5 * rng.standard_normal(43)), 7))
    lost = fit_scale_to_distances(TIMES, places, TIMES, spinning, None, 0.01)
    with pytest.raises(DegenerateGeometryError, match="known to"):
        agreed_scale([lost])
    with pytest.raises(ConfigError, match="share"):
        fit_scale_to_distances(TIMES, places, TIMES, wheels, None, 1.5)
    with pytest.raises(ShapeError, match="either"):
        fit_scale_to_distances(TIMES, places, TIMES, wheels, places, 0.01)
