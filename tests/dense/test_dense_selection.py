"""Sources of each view: near ones with common points, at useful angles, from several sides."""

import tracemalloc

import numpy as np
import pytest
from dense_scenes import CAMERA, RANGE, rendered

from epipole.dense.frustum_sources import select_by_frusta
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


def frustum_points(views, near, far):
    """12 x 12 rays of each view at five depths, and all observations of these points, at once."""
    u, v = np.meshgrid(np.linspace(0, CAMERA.width - 1, 12), np.linspace(0, CAMERA.height - 1, 12))
    rays = np.linalg.solve(CAMERA.K, np.stack([u.ravel(), v.ravel(), np.ones(u.size)])).T
    in_cam = (rays[:, None] / np.linspace(1 / far, 1 / near, 5)[:, None]).reshape(-1, 3)
    points = np.concatenate([view.cam_from_world.inverse().apply(in_cam) for view in views])
    rows = []
    for view in views:
        x, y, z = (CAMERA.K @ view.cam_from_world.apply(points).T).reshape(3, -1)
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = (np.abs(x / z - (CAMERA.width - 1) / 2) < CAMERA.width / 2) & (
                np.abs(y / z - (CAMERA.height - 1) / 2) < CAMERA.height / 2
            )
        rows.append(np.flatnonzero(inside & (z > 0.5 * near) & (z < 2 * far)))
    view = np.repeat(np.arange(len(views)), [len(row) for row in rows])
    return SharedPoints(points, view, np.concatenate(rows))


def test_sources_by_frusta_are_those_of_all_points_in_a_fraction_of_the_memory():
    views, _ = rendered()
    ranges = np.tile(RANGE, (len(views), 1))
    centers = np.array([view.cam_from_world.centers() for view in views])
    points = frustum_points(views, *RANGE)
    wanted = select_sources(points, centers, np.full(len(views), CAMERA.focal_px), 5)
    tracemalloc.start()
    try:
        found = select_by_frusta(views, ranges, 5)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(found) == len(wanted) == 24 and all(len(row) for row in wanted)
    for one, other in zip(found, wanted):
        np.testing.assert_array_equal(one, other)
    bytes_of_points = points.points_in_world.nbytes
    assert peak < 30 * bytes_of_points  # a few arrays of points; not a column for each pair of views
    assert select_by_frusta([], np.empty((0, 2)), 5) == []
    with pytest.raises(ConfigError, match="most"):
        select_by_frusta(views, ranges, 0)
