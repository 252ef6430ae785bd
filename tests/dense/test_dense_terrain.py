"""Terrain models: the ground below houses and trees."""

import numpy as np
import pytest

from epipole.dense.terrain import filled, terrain_model
from epipole.errors import ConfigError, ShapeError


def hills(resolution, side_m=120.0, slope=0.1):
    n = round(side_m / resolution)
    y, x = (np.mgrid[:n, :n] + 0.5) * resolution
    return (500.0 + slope * x + 2.0 * np.sin(y / 15.0)).astype(np.float32)


@pytest.mark.parametrize("resolution", [0.1, 0.5, 2.0])
def test_houses_and_trees_are_removed_and_the_ground_stays(resolution):
    ground = hills(resolution)
    surface, rng = ground.copy(), np.random.default_rng(0)
    for _ in range(8):
        y, x = rng.uniform(15, 105, 2)
        h, w = rng.uniform(4, 10, 2)
        rows, columns = (
            slice(int((c - r) / resolution), int((c + r) / resolution)) for c, r in ((y, h), (x, w))
        )
        surface[rows, columns] = ground[rows, columns].max() + rng.uniform(3, 7)
    surface[rng.uniform(size=surface.shape) < 0.02] += 4.0
    found = terrain_model(surface, resolution)
    is_object = surface > ground + 1.0
    assert 0.05 < is_object.mean() < 0.6
    error = np.abs(found - ground)
    assert np.median(error[is_object]) < 0.3 and np.quantile(error[is_object], 0.95) < 1.2
    assert np.quantile(error[~is_object], 0.95) < 0.1


def test_unknown_cells_stay_unknown_and_a_slope_is_ground():
    surface = hills(0.5, slope=0.15)
    surface[20:30, 40:60] = np.nan
    found = terrain_model(surface, 0.5)
    assert (np.isnan(found) == np.isnan(surface)).all()
    known = np.isfinite(surface)
    np.testing.assert_allclose(found[known], surface[known], atol=0.05)


def test_filling_keeps_what_is_known_and_interpolates_smoothly():
    plane = (0.1 * np.mgrid[:64, :64].sum(axis=0)).astype(np.float32)
    holes = plane.copy()
    holes[20:40, 25:45] = np.nan
    result = filled(holes)
    known = np.isfinite(holes)
    np.testing.assert_array_equal(result[known], plane[known])
    assert np.abs(result - plane).max() < 1.0 and np.isfinite(result).all()


def test_bad_input_is_named():
    with pytest.raises(ShapeError, match="no height"):
        terrain_model(np.full((4, 4), np.nan, np.float32), 1.0)
    with pytest.raises(ConfigError, match="resolution"):
        terrain_model(np.zeros((4, 4), np.float32), 0.0)
    single = np.array([[3.0]], np.float32)
    np.testing.assert_array_equal(terrain_model(single, 1.0), single)
