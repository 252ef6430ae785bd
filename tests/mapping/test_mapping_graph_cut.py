"""Division of view graphs."""

import numpy as np
import pytest

from epipole.errors import ConfigError, ShapeError
from epipole.mapping import divide_images, nearest_outside


def chain(count: int, reach: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of each image with the next `reach` ones, with fewer matches the farther they are."""
    first = np.repeat(np.arange(count), reach)
    second = first + np.tile(np.arange(1, reach + 1), count)
    inside = second < count
    weight = 100.0 / (second - first)
    return first[inside].astype(np.int32), second[inside].astype(np.int32), weight[inside]


def test_a_chain_is_cut_into_consecutive_images():
    parts = divide_images(1000, *chain(1000, 10), most=300)
    assert sorted(np.concatenate(parts).tolist()) == list(range(1000))
    assert all(len(part) <= 300 and np.ptp(part) == len(part) - 1 for part in parts)
    assert len(parts) <= 6


def test_groups_are_not_cut_through(rng):
    group = rng.permutation(np.repeat(np.arange(4), [60, 50, 40, 30]))
    first, second = np.triu_indices(len(group), 1)
    together = group[first] == group[second]
    kept = (together & (rng.random(len(first)) < 0.3)) | (rng.random(len(first)) < 0.01)
    pairs = first[kept].astype(np.int32), second[kept].astype(np.int32)
    parts = divide_images(len(group), *pairs, rng.uniform(50.0, 150.0, kept.sum()), most=65)
    assert [np.unique(group[part]).tolist() for part in parts] == [[0], [1], [2], [3]]
    assert [len(part) for part in parts] == [60, 50, 40, 30]


def test_a_cut_may_leave_images_without_a_pair():
    """Every pair of a star has its center: one side of each cut has no pair at all."""
    center, others = np.zeros(40, np.int32), np.arange(1, 41, dtype=np.int32)
    parts = divide_images(41, center, others, np.linspace(1.0, 2.0, 40), most=10)
    assert len(parts) == 1 and 0 in parts[0] and len(parts[0]) <= 10


def test_components_stay_apart_and_single_images_are_in_none():
    pairs = np.array([[0, 1], [1, 2], [4, 5]], np.int32).T.copy()
    parts = divide_images(6, *pairs, np.ones(3), most=10)
    assert [part.tolist() for part in parts] == [[0, 1, 2], [4, 5]]
    assert divide_images(3, *np.zeros((2, 0), np.int32), np.zeros(0), most=10) == ()


def test_the_nearest_images_outside_have_the_strongest_connection():
    found = nearest_outside(np.arange(10), 20, *chain(20, 5), most=3)
    assert found.tolist() == [10, 11, 12]
    assert nearest_outside(np.arange(20), 20, *chain(20, 5), most=3).tolist() == []
    assert nearest_outside(np.arange(15, 20), 20, *chain(20, 5), most=3).tolist() == [14, 13, 12]
    assert nearest_outside(np.arange(20), 20, *(column[:0] for column in chain(20, 5)), most=3).tolist() == []


@pytest.mark.parametrize("weight", [0.0, -1.0, np.nan, np.inf])
def test_weights_that_mean_nothing_are_refused(weight):
    pair = np.array([0], np.int32), np.array([1], np.int32)
    with pytest.raises(ConfigError, match="positive and finite"):
        divide_images(2, *pair, np.array([weight]), most=2)


def test_images_that_do_not_exist_are_refused():
    pair = np.array([0], np.int32), np.array([7], np.int32)
    with pytest.raises(ShapeError, match="image2"):
        divide_images(2, *pair, np.ones(1), most=2)
