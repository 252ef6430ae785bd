"""Clusters from evidence, against all partitions of a few images, and rigid parts of models."""

from itertools import combinations, product

import numpy as np
import pytest

from epipole.errors import ConfigError
from epipole.mapping import cluster_images, largest_rigid_part


def cost(labels, pairs, weight):
    """Evidence that a partition contradicts."""
    apart = np.array([labels[i] != labels[j] for i, j in pairs])
    return float(np.where(apart, weight, -weight).clip(min=0.0).sum())


@pytest.mark.parametrize("seed", range(5))
def test_clear_clusters_are_the_best_partition(seed):
    rng = np.random.default_rng(seed)
    truth, pairs = rng.integers(0, 3, 7), list(combinations(range(7), 2))
    sign = np.array([1.0 if truth[i] == truth[j] else -1.0 for i, j in pairs])
    weight = sign * rng.uniform(0.5, 2.0, len(pairs))
    weight[rng.choice(len(pairs), 2)] *= -0.1  # weak evidence for what is wrong
    found = cluster_images(7, *np.array(pairs, np.int32).T.copy(), weight)
    best = min(cost(labels, pairs, weight) for labels in product(range(4), repeat=7))
    assert cost(found, pairs, weight) == pytest.approx(best)
    assert found[0] == 0 and (np.diff(np.maximum.accumulate(found)) <= 1).all()  # numbered by first image


def test_images_without_evidence_stay_alone():
    none = np.zeros(0, np.int32)
    np.testing.assert_array_equal(cluster_images(3, none, none, np.zeros(0)), [0, 1, 2])
    one = np.array([0], np.int32)
    np.testing.assert_array_equal(cluster_images(2, one, one + 1, np.array([-1.0])), [0, 1])
    np.testing.assert_array_equal(cluster_images(2, one, one + 1, np.array([1.0])), [0, 0])


@pytest.mark.parametrize("image, weight", [(5, 1.0), (-1, 1.0), (1, np.nan)])
def test_unusable_evidence_is_refused(image, weight):
    with pytest.raises(ConfigError, match="pair"):
        cluster_images(3, np.array([0], np.int32), np.array([image], np.int32), np.array([weight]))


def chain(num_images, images_of_a_point, cut=None):
    """Ten points for each group of neighboring images in a row; none of more than two images that spans the cut."""
    image, point, count = [], [], 0
    for first in range(num_images - images_of_a_point + 1):
        group = list(range(first, first + images_of_a_point))
        if cut is not None and group[0] < cut < group[-1]:
            continue
        for _ in range(10):
            image += group
            point += [count] * len(group)
            count += 1
    return np.array(image), np.array(point)


def test_a_chain_of_points_in_three_images_is_rigid():
    image, point = chain(9, 3)
    assert largest_rigid_part(9, image, point).all()
    shuffled = np.random.default_rng(0).permutation(len(image))
    assert largest_rigid_part(9, image[shuffled], point[shuffled]).all()


def test_parts_that_share_one_camera_have_scales_of_their_own():
    """Images 0 to 5 and 5 to 8: no point connects them beyond image 5."""
    image, point = chain(9, 3, cut=5)
    np.testing.assert_array_equal(largest_rigid_part(9, image, point), np.arange(9) <= 5)


def test_pairs_alone_have_scales_of_their_own():
    image, point = chain(6, 2)
    assert largest_rigid_part(6, image, point).sum() == 2
    assert not largest_rigid_part(6, np.zeros(0, np.int64), np.zeros(0, np.int64)).any()


def test_few_points_do_not_determine_a_scale():
    image, point = chain(3, 3)
    few = point < 5
    assert largest_rigid_part(3, image[few], point[few], min_points=6).sum() == 1
    assert largest_rigid_part(3, image[few], point[few], min_points=5).all()
    twice = np.concatenate([image[few]] * 2), np.concatenate([point[few]] * 2)  # says nothing more
    assert largest_rigid_part(3, *twice, min_points=6).sum() == 1
    with pytest.raises(ConfigError, match="min_points"):
        largest_rigid_part(3, image, point, min_points=0)


def test_few_points_of_an_image_with_many_do_not_determine_a_scale():
    image, point = chain(9, 3, cut=5)
    link = np.array([4, 5, 6] * 6), np.repeat(1000 + np.arange(6), 3)  # wrong matches that fit by chance
    own = np.repeat([4, 6], 200), 2000 + np.arange(400)  # seen once
    image, point = (np.concatenate(rows) for rows in zip((image, point), link, own))
    assert largest_rigid_part(9, image, point).all()
    assert not largest_rigid_part(9, image, point, min_fraction=0.08).all()
    with pytest.raises(ConfigError, match="min_fraction"):
        largest_rigid_part(9, image, point, min_fraction=1.5)
