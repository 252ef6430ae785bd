"""Rotation averaging, and pairs that break the cycles of rotations."""

from itertools import combinations

import numpy as np
import pytest

from epipole.errors import ShapeError
from epipole.geometry import Rotation3
from epipole.mapping import check_rotation_cycles
from epipole.mapping.rotation_averaging import average_rotations, triangle_support
from mapping_graphs import graph_of_rotations


def random_rotations(rng, count):
    return Rotation3.exp(rng.normal(size=(count, 3))).matrix


def relative(rotations, pairs, noise_rad=0.0, rng=None):
    out = np.array([rotations[j] @ rotations[i].T for i, j in pairs])
    if noise_rad:
        out = Rotation3.exp(noise_rad * rng.normal(size=(len(out), 3))).matrix @ out
    return out


def angles_deg(one, other):
    return np.degrees(np.linalg.norm(Rotation3(one @ np.swapaxes(other, 1, 2)).log(), axis=1))


def averaged(num_images, pairs, relatives, weights=None):
    first, second = np.array(pairs, np.int32).T
    weights = np.ones(len(pairs)) if weights is None else weights
    return average_rotations(num_images, first.copy(), second.copy(), relatives, weights)


def error_deg(found, truth):
    """Largest angle after the rotation that brings the first camera into agreement."""
    gauge = found.cams_from_world[0].T @ truth[0]
    return angles_deg(found.cams_from_world @ gauge, truth).max()


ALL = [(i, j) for i in range(12) for j in range(i + 1, 12)]


def test_exact_rotations_are_recovered(rng):
    truth = random_rotations(rng, 12)
    found = averaged(12, ALL, relative(truth, ALL))
    assert error_deg(found, truth) < 1e-6
    assert found.residuals_rad.max() < 1e-7


def test_the_tree_alone_gives_the_rotations_of_a_chain(rng):
    truth = random_rotations(rng, 5)
    pairs = [(0, 1), (2, 1), (2, 3), (4, 3)]
    assert error_deg(averaged(5, pairs, relative(truth, pairs)), truth) < 1e-6


def test_noise_averages_out(rng):
    truth = random_rotations(rng, 12)
    noise = np.radians(1.0)
    found = averaged(12, ALL, relative(truth, ALL, noise, rng))
    assert error_deg(found, truth) < 2.0  # eleven pairs per image: about 1 / sqrt(11) degrees per axis


@pytest.mark.parametrize("seed", range(10))
def test_a_third_of_wrong_pairs_changes_little(seed):
    rng = np.random.default_rng(seed)
    truth = random_rotations(rng, 12)
    relatives = relative(truth, ALL, np.radians(0.3), rng)
    is_wrong = rng.permutation(len(ALL)) < len(ALL) // 3
    relatives[is_wrong] = random_rotations(rng, int(is_wrong.sum()))
    found = averaged(12, ALL, relatives)
    assert error_deg(found, truth) < 2.0
    is_far = found.residuals_rad > np.radians(10.0)
    assert not is_far[~is_wrong].any()
    assert is_far[is_wrong].mean() > 0.9  # a random rotation is within 10 degrees once in about a thousand


def test_components_have_their_own_frames(rng):
    truth = random_rotations(rng, 6)
    pairs = [(0, 1), (1, 2), (0, 2), (3, 4), (4, 5)]
    found = averaged(7, pairs, relative(truth, pairs))
    assert found.component[:3].tolist() == [found.component[0]] * 3
    assert len({int(found.component[k]) for k in (0, 3, 6)}) == 3
    assert found.residuals_rad.max() < 1e-7


def test_order_and_direction_of_pairs_do_not_matter(rng):
    truth = random_rotations(rng, 12)
    relatives = relative(truth, ALL, np.radians(0.5), rng)
    one = averaged(12, ALL, relatives)
    order = rng.permutation(len(ALL))
    swapped = [(j, i) for i, j in ALL]
    other = averaged(12, [swapped[k] for k in order], np.swapaxes(relatives, 1, 2)[order])
    assert np.abs(one.residuals_rad[order] - other.residuals_rad).max() < 1e-4


def test_no_pair_leaves_every_image_alone():
    nothing = np.zeros(0, np.int32)
    found = average_rotations(3, nothing, nothing, np.zeros((0, 3, 3)), np.zeros(0))
    assert len({*found.component.tolist()}) == 3 and len(found.residuals_rad) == 0


def test_an_image_that_does_not_exist_is_refused():
    one = np.zeros(1, np.int32)
    with pytest.raises(ShapeError, match="image2"):
        average_rotations(2, one, one + 5, np.eye(3)[None], np.ones(1))


def test_pairs_that_break_cycles_are_found_whatever_their_matches(rng):
    truth = random_rotations(rng, 12)
    relatives = relative(truth, ALL, np.radians(0.5), rng)
    wrong = [3, 20, 41]
    relatives[wrong] = random_rotations(rng, 3)
    matches = np.full(len(ALL), 200)
    matches[wrong] = 40
    graph = graph_of_rotations(ALL, relatives, matches)
    has_rotation = np.ones(len(ALL), bool)
    found = check_rotation_cycles(graph, 12, has_rotation, np.radians(10.0))
    assert np.flatnonzero(found.contradicts).tolist() == wrong
    has_rotation[wrong[0]] = False
    found = check_rotation_cycles(graph, 12, has_rotation, np.radians(10.0))
    assert np.flatnonzero(found.contradicts).tolist() == wrong[1:] and np.isnan(found.angle_rad[wrong[0]])


def test_a_pair_in_no_cycle_is_not_accused(rng):
    relatives = random_rotations(rng, 2)
    graph = graph_of_rotations([(0, 1), (1, 2)], relatives, np.array([30, 500]))
    found = check_rotation_cycles(graph, 3, np.ones(2, bool), np.radians(10.0))
    assert not found.contradicts.any()


def test_support_is_that_of_all_triangles(rng):
    """Against a loop over all triples of images; pairs in both orders, and one wrong pair."""
    n = 9
    truth = random_rotations(rng, n)
    pairs = [
        (i, j) if rng.random() < 0.5 else (j, i)
        for i in range(n)
        for j in range(i + 1, n)
        if rng.random() < 0.7
    ]
    relatives = relative(truth, pairs)
    relatives[3] = random_rotations(rng, 1)[0]
    weights = rng.uniform(1, 5, len(pairs))
    edge = {frozenset(pair): e for e, pair in enumerate(pairs)}
    support, possible = np.zeros(len(pairs)), np.zeros(len(pairs))
    for a, b, c in combinations(range(n), 3):
        sides = [frozenset(s) for s in ((a, b), (b, c), (a, c))]
        if all(s in edge for s in sides):
            e = [edge[s] for s in sides]
            for k in range(3):
                smaller = min(weights[e[k - 1]], weights[e[k - 2]])
                possible[e[k]] += smaller
                support[e[k]] += smaller if 3 not in e else 0.0
    first, second = np.array(pairs, np.int32).T
    found = triangle_support(n, first, second, relatives, weights)
    np.testing.assert_allclose(found[0], support)
    np.testing.assert_allclose(found[1], possible)
