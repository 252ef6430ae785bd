"""Scale from measured places: the truth lies within what is stated, and too little is refused."""

import numpy as np
import pytest

from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rotation3, Similarity3
from epipole.scale import fit_scale_to_positions


def path(rng, count=60):
    """A walk in a plane, a little up and down."""
    angle = np.linspace(0, 5, count)
    return np.stack([3 * np.cos(angle), 2 * np.sin(1.3 * angle), 0.2 * rng.standard_normal(count)], axis=1)


def test_the_true_scale_lies_within_what_is_stated(rng):
    away = []
    for _ in range(300):
        model = path(rng)
        truth = Similarity3(np.array(2.5), Rotation3.exp(rng.normal(size=3)).matrix, rng.normal(size=3))
        measured = truth.apply(model) + 0.1 * rng.standard_normal(model.shape)
        fit = fit_scale_to_positions(model, measured, 0.1)
        away.append((float(fit.world_from_model.scale) - 2.5) / fit.sigma)
    away = np.array(away)
    assert 0.85 < away.std() < 1.1 and (np.abs(away) < 2).mean() > 0.92


def test_wrong_places_do_not_count(rng):
    model = path(rng)
    measured = 2.0 * model + 0.02 * rng.standard_normal(model.shape)
    measured[::6] += 5.0 * rng.standard_normal(measured[::6].shape)
    fit = fit_scale_to_positions(model, measured, 0.02)
    assert float(fit.world_from_model.scale) == pytest.approx(2.0, abs=4 * fit.sigma)
    assert not fit.kept_mask[::6].all() and fit.kept_mask.sum() >= 48
    assert "of 60" in repr(fit)


def test_noise_that_is_larger_than_stated_is_seen(rng):
    model = path(rng)
    fit = fit_scale_to_positions(model, 2.0 * model + 0.2 * rng.standard_normal(model.shape), 0.001)
    assert fit.sigma > 0.15 / np.sqrt(((model - model.mean(axis=0)) ** 2).sum())


def test_too_little_is_refused(rng):
    model = path(rng)
    with pytest.raises(DegenerateGeometryError, match="too little to determine the scale"):
        fit_scale_to_positions(model, 0.01 * model + rng.standard_normal(model.shape), 1.0)
    with pytest.raises(DegenerateGeometryError, match="5 are needed"):
        fit_scale_to_positions(model[:4], model[:4], 0.1)
    line = np.linspace(0, 5, 30)[:, None] * np.array([1.0, 2.0, 0.5])
    with pytest.raises(DegenerateGeometryError, match="line"):
        fit_scale_to_positions(line, line, 0.1)
    with pytest.raises(ConfigError, match="sigma"):
        fit_scale_to_positions(model, model, 0.0)
    with pytest.raises(ShapeError, match="finite"):
        fit_scale_to_positions(model, model * np.nan, 0.1)
