"""Umeyama's alignment: exact data, noise, mirrors, planes, lines."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation as ScipyRotation

from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Similarity3, align_points


def cost(similarity: Similarity3, source: np.ndarray, target: np.ndarray) -> float:
    return float(((similarity.apply(source) - target) ** 2).sum())


def assert_local_minimum(
    found: Similarity3,
    source: np.ndarray,
    target: np.ndarray,
    rng: np.random.Generator,
    *,
    scale: bool = True,
) -> None:
    best = cost(found, source, target)
    for step in rng.normal(size=(60, 7)) * rng.choice([1e-3, 1e-1], (60, 1)):
        step[6] *= scale
        assert cost(Similarity3.exp(step) @ found, source, target) >= best


@pytest.mark.parametrize("flatness", [1.0, 1e-2, 1e-6, 0.0])
@pytest.mark.parametrize("noise", [0.01, 0.5, 3.0])
def test_noisy_alignment_is_a_proper_rotation_and_the_best(
    flatness: float, noise: float, rng: np.random.Generator
) -> None:
    """Near a plane and under strong noise the best orthogonal matrix is often a mirror."""
    truth = Similarity3.exp(rng.normal(size=7))
    for _ in range(10):
        source = rng.normal(size=(8, 3)) * [1, 1, flatness]
        target = truth.apply(source) + noise * rng.normal(size=(8, 3))
        found = align_points(source, target)
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)
        assert_local_minimum(found, source, target, rng)


def test_mirrored_points_are_not_mirrored_back(rng: np.random.Generator) -> None:
    source = rng.normal(size=(20, 3))
    target = source * [1, 1, -1]
    found = align_points(source, target)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert cost(found, source, target) > 1.0
    assert_local_minimum(found, source, target, rng)


@pytest.mark.parametrize("flatness", [1, 0])
def test_exact_points_give_the_similarity_that_moved_them(flatness: int, rng: np.random.Generator) -> None:
    for _ in range(20):
        source = rng.normal(size=(5, 3)) * [1, 1, flatness]
        truth = Similarity3.exp(rng.normal(size=7) * [10, 10, 10, 1, 1, 1, 1])
        found = align_points(source, truth.apply(source))
        np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-12)
        np.testing.assert_allclose(found.scale, truth.scale)
        np.testing.assert_allclose(found.translation, truth.translation, atol=1e-11)


def test_rotation_equals_scipy(rng: np.random.Generator) -> None:
    source, target = rng.normal(size=(2, 12, 3))
    expected, _ = ScipyRotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))
    np.testing.assert_allclose(align_points(source, target).rotation, expected.as_matrix(), atol=1e-7)


def test_the_optimum_is_global(rng: np.random.Generator) -> None:
    source, target = rng.normal(size=(2, 6, 3))
    found = cost(align_points(source, target), source, target)
    starts = rng.normal(size=(10, 7))
    ends = [minimize(lambda x: cost(Similarity3.exp(x), source, target), x).fun for x in starts]
    assert found == pytest.approx(min(ends), rel=1e-6)


def test_without_scale(rng: np.random.Generator) -> None:
    source = rng.normal(size=(9, 3))
    truth = Similarity3.exp([1.0, 0.0, -2.0, 0.1, 0.2, 1.3, np.log(2.0)])
    found = align_points(source, truth.apply(source), with_scale=False)
    assert found.scale == 1.0
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-12)
    assert_local_minimum(found, source, truth.apply(source), rng, scale=False)


def test_three_points_far_from_the_origin() -> None:
    source = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]) + 1e6
    truth = Similarity3(np.array(3.0), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([5.0, 6, 7]))
    found = align_points(source, truth.apply(source))
    np.testing.assert_allclose(found.apply(source), truth.apply(source), atol=1e-8)
    np.testing.assert_allclose(found.scale, 3.0, rtol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_points(count: int) -> None:
    with pytest.raises(DegenerateGeometryError, match=f"at least 3 points, got {count}"):
        align_points(np.ones((count, 3)), np.ones((count, 3)))


@pytest.mark.parametrize("direction", [[1.0, 0, 0], [0.3, -0.2, 0.9], [0.0, 0, 0]])
def test_points_on_a_line_or_in_a_heap(direction: list[float]) -> None:
    source = np.arange(6.0)[:, None] * direction + [1.0, 2.0, 3.0]
    with pytest.raises(DegenerateGeometryError, match="line"):
        align_points(source, Similarity3.exp(np.full(7, 0.3)).apply(source))


def test_bad_arrays_are_named() -> None:
    good = np.eye(3)
    with pytest.raises(ShapeError, match="source has 3, target has 4"):
        align_points(good, np.ones((4, 3)))
    with pytest.raises(ShapeError, match="target must be finite; 1 values"):
        align_points(good, [[0.0, 1.0, 2.0], [np.nan, 0.0, 0.0], [1.0, 0.0, 1.0]])
    with pytest.raises(ShapeError, match="source must be"):
        align_points(np.eye(4), good)
