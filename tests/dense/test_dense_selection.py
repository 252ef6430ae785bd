"""Sources of each view: near ones with common points, at useful angles, from several sides."""

import numpy as np
import pytest

from epipole.dense.source_selection import SharedPoints, depth_range, select_sources
from epipole.errors import ConfigError, ShapeError


def on_a_line(num_views=9, num_points=300):
    """Cameras along x, two units from a wall, each seeing the points within one and a half units."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 2], [5, 1, 2.3], (num_points, 3))
    centers = np.stack([np.linspace(0, 4, num_views), np.zeros(num_views), np.zeros(num_views)], axis=1)
    seen = [np.flatnonzero(np.abs(points[:, 0] - center[0]) < 1.5) for center in centers]
    view = np.repeat(np.arange(num_views), [len(row) for row in seen])
    return SharedPoints(points, view, np.concatenate(seen)), centers


def test_sources_are_near_and_on_both_sides():
    points, centers = on_a_line()
    sources = select_sources(points, centers, np.full(9, 500.0), 4)
    for view in range(9):
        assert 3 <= len(sources[view]) <= 4 and view not in sources[view]
        assert np.abs(sources[view] - view).max() <= (3 if 2 <= view <= 6 else 5)
    assert {3, 5} & set(sources[4][:2].tolist()) and (sources[4] < 4).any() and (sources[4] > 4).any()


def test_views_without_common_points_or_without_a_baseline_are_no_sources():
    points, centers = on_a_line()
    far = SharedPoints(points.points_in_world, points.view_of_observation, points.point_of_observation)
    apart = np.where(far.view_of_observation == 0)[0]
    only = SharedPoints(
        points.points_in_world, np.zeros(len(apart), np.int64), far.point_of_observation[apart]
    )
    assert all(not len(row) for row in select_sources(only, centers, np.full(9, 500.0), 4))
    same = np.zeros_like(centers)
    assert all(not len(row) for row in select_sources(points, same, np.full(9, 500.0), 4))


def test_a_much_closer_view_counts_less():
    points, centers = on_a_line()
    focals = np.full(9, 500.0)
    focals[3] = 4000.0
    assert 3 not in select_sources(points, centers, focals, 1)[4]


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments_are_refused():
    points, centers = on_a_line()
    with pytest.raises(ConfigError, match="most"):
        select_sources(points, centers, np.full(9, 500.0), 0)
    with pytest.raises(ShapeError, match="point_of_observation"):
        SharedPoints(points.points_in_world, points.view_of_observation[:-1], points.point_of_observation)


def test_the_range_contains_the_points_with_a_margin():
    near, far = depth_range(np.linspace(2.0, 6.0, 100))
    assert 1.2 < near < 2.0 and 6.0 < far <= 120.0
    assert depth_range(np.array([-1.0, np.nan])) is None
    near, far = depth_range(np.array([3.0]))
    assert near < 3.0 < far
