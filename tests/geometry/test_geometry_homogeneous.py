"""Points and lines: l . x = 0."""

import numpy as np
import pytest

from epipole.errors import ShapeError
from epipole.geometry import (
    from_homogeneous,
    intersection_of,
    line_through,
    point_line_distance,
    to_homogeneous,
)
from epipole.geometry.homogeneous import normalize_lines


def test_there_and_back(rng: np.random.Generator) -> None:
    for shape in ((2,), (0, 2), (5, 3), (2, 4, 3)):
        points = rng.normal(size=shape)
        lifted = to_homogeneous(points)
        assert lifted.shape == (*shape[:-1], shape[-1] + 1) and (lifted[..., -1] == 1).all()
        np.testing.assert_allclose(from_homogeneous(-2.5 * lifted), points, atol=1e-15)


def test_points_at_infinity_are_not_finite() -> None:
    found = from_homogeneous([[1.0, -2.0, 0.0], [0.0, 1.0, 0.0], [4.0, 2.0, 2.0]])
    np.testing.assert_array_equal(found[[0, 2]], [[np.inf, -np.inf], [2.0, 1.0]])
    assert not np.isfinite(found[1]).any()


def test_line_through_two_points() -> None:
    # x + y = 1 at 45 degrees, and the vertical x = 3.
    lines = line_through([[1.0, 0.0], [3.0, -5.0]], [[0.0, 1.0], [3.0, 8.0]])
    np.testing.assert_allclose(lines, np.array([[-1, -1, 1], [-1, 0, 3]]) / [[np.sqrt(2)], [1]], atol=1e-15)
    np.testing.assert_allclose(point_line_distance([[0.0, 0.0], [7.0, 1.0]], lines), [np.sqrt(0.5), 4.0])


def test_both_points_lie_on_their_line(rng: np.random.Generator) -> None:
    a, b = rng.uniform(0, 4000, (2, 50, 2))
    lines = line_through(a, b)
    np.testing.assert_allclose(np.linalg.norm(lines[:, :2], axis=1), 1.0)
    assert max(point_line_distance(a, lines).max(), point_line_distance(b, lines).max()) < 1e-9
    np.testing.assert_allclose(line_through(b, a), -lines)
    middle = 0.3 * a + 0.7 * b
    assert point_line_distance(middle, lines).max() < 1e-9
    beside = middle + 2.5 * lines[:, :2]
    np.testing.assert_allclose(point_line_distance(beside, lines), 2.5)


def test_the_same_point_twice_has_no_line() -> None:
    assert np.isnan(line_through([2.0, 3.0], [2.0, 3.0])).all()


def test_lines_meet_in_the_point_they_share(rng: np.random.Generator) -> None:
    shared, a, b = rng.uniform(-9, 9, (3, 20, 2))
    np.testing.assert_allclose(intersection_of(line_through(shared, a), line_through(shared, b)), shared)


def test_parallel_and_equal_lines_do_not_meet() -> None:
    one, other = line_through([0.0, 0.0], [1.0, 2.0]), line_through([5.0, 0.0], [6.0, 2.0])
    assert not np.isfinite(intersection_of(one, other)).any()
    assert not np.isfinite(intersection_of(one, one)).any()


def test_distance_does_not_depend_on_the_scale_of_the_line() -> None:
    distance = point_line_distance([4.0, 9.0], [0.0, -20.0, 100.0])
    assert isinstance(distance, np.ndarray) and float(distance) == 4.0
    assert point_line_distance(np.zeros((0, 2)), np.zeros((0, 3))).shape == (0,)


def test_one_line_for_many_points() -> None:
    np.testing.assert_allclose(point_line_distance([[0.0, 1.0], [0.0, -3.0]], [0.0, 2.0, 0.0]), [1.0, 3.0])


def test_the_line_at_infinity_and_nan() -> None:
    assert not np.isfinite(normalize_lines([0.0, 0.0, 1.0])).all()
    assert np.isnan(point_line_distance([np.nan, 0.0], [1.0, 0.0, 0.0]))


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ShapeError, match="lines_b"):
        intersection_of([1.0, 0.0, 0.0], [1.0, 0.0])
    with pytest.raises(ShapeError, match="lines"):
        point_line_distance([1.0, 0.0], [1.0, 0.0])
