"""Positions from the directions between pairs: exact, with wrong pairs, along a chain, and where pairs determine nothing."""

import numpy as np
import pytest

from epipole.errors import ConfigError, ShapeError
from epipole.geometry import align_points
from epipole.mapping import PairDirections, position_globally
from epipole.mapping.positions import global_positioning
from epipole.mapping.positions.laplacian import solve_laplacian
from epipole.mapping.positions.start_positions import positions_from_pairs
from epipole.mapping.sorting import distinct


def chain(rng, num_images=120, per_image=15, noise_rad=0.0):
    """Cameras on a line that curves, whose points are each seen by five neighbors."""
    along = np.arange(num_images) * 0.5
    centers = np.stack([along, 3.0 * np.sin(0.15 * along), 0.05 * rng.normal(size=num_images)], axis=1)
    first = np.repeat(np.arange(num_images - 4), per_image)
    image = (first[:, None] + np.arange(5)).ravel()
    points = centers[first + 2] + [0.0, 0.0, 4.0] + rng.uniform(-2.0, 2.0, (len(first), 3))
    offsets = 5 * np.arange(len(first) + 1, dtype=np.int64)
    ray = np.repeat(points, 5, axis=0) - centers[image]
    return centers, points, offsets, image.astype(np.int32), directions(ray, rng, noise_rad)


def directions(rays, rng, noise_rad=0.0):
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    noisy = unit + noise_rad * rng.normal(size=unit.shape)
    return noisy / np.linalg.norm(noisy, axis=1, keepdims=True)


def pairs_of(centers, rng, noise_rad=0.0, reach=4):
    i, j = np.array(
        [(i, i + d) for i in range(len(centers)) for d in range(1, reach) if i + d < len(centers)]
    ).T
    return PairDirections(
        i.astype(np.int32), j.astype(np.int32), directions(centers[j] - centers[i], rng, noise_rad)
    )


def errors(found, truth):
    moved = align_points(found, truth).apply(found)
    return np.linalg.norm(moved - truth, axis=1)


def test_exact_directions_give_the_positions(rng):
    centers, points, offsets, image, seen = chain(rng)
    found = positions_from_pairs(len(centers), offsets, image, seen, pairs_of(centers, rng))
    assert errors(found.centers, centers).max() < 0.02  # of 60: conjugate gradients end at a tolerance
    assert np.median(errors(found.points, points)) < 0.02


def test_directions_that_disagree_with_the_rays_are_corrected(rng):
    centers, _, offsets, image, seen = chain(rng, 40)
    found = positions_from_pairs(40, offsets, image, seen, pairs_of(centers, rng, noise_rad=0.03))
    assert errors(found.centers, centers).max() < 0.02


def test_the_order_of_pairs_and_of_observations_does_not_matter(rng):
    centers, _, offsets, image, seen = chain(rng, 30)
    pairs = pairs_of(centers, rng)
    one = positions_from_pairs(30, offsets, image, seen, pairs)
    turned = PairDirections(pairs.image2[::-1], pairs.image1[::-1], -pairs.direction_in_world[::-1])
    backward = np.arange(len(image)).reshape(-1, 5)[:, ::-1].ravel()
    other = positions_from_pairs(30, offsets, image[backward], seen[backward], turned)
    assert errors(other.centers, one.centers).max() < 1e-2


def test_wrong_pairs_have_little_influence(rng):
    centers, _, offsets, image, seen = chain(rng, noise_rad=0.001)
    pairs = pairs_of(centers, rng, noise_rad=0.01)
    direction = pairs.direction_in_world.copy()
    wrong = rng.choice(len(pairs), len(pairs) // 20, replace=False)
    direction[wrong] = directions(rng.normal(size=(len(wrong), 3)), rng)
    found = positions_from_pairs(
        len(centers), offsets, image, seen, PairDirections(pairs.image1, pairs.image2, direction)
    )
    assert np.median(errors(found.centers, centers)) < 3.0  # of 60: the noise of a chain adds up


def test_global_positions_along_a_chain_need_few_steps(rng, monkeypatch):
    centers, _, offsets, image, seen = chain(rng, noise_rad=0.001)
    steps = []
    reduce = global_positioning.kernels.reduce_points
    monkeypatch.setattr(
        global_positioning.kernels, "reduce_points", lambda *a: (steps.append(0), reduce(*a))[1]
    )
    found = position_globally(len(centers), offsets, image, seen, 0, pairs_of(centers, rng, 0.01))
    assert len(steps) <= 20
    neighbors = np.linalg.norm(np.diff(found.centers_in_world, axis=0), axis=1)
    ratio = neighbors / np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert np.ptp(np.log(ratio[5:-5])) < 0.7 and np.median(found.angles_rad) < 0.003


def test_images_without_pairs_have_no_position(rng):
    centers, _, offsets, image, seen = chain(rng, 30)
    pairs = pairs_of(centers, rng)
    kept = (pairs.image1 < 19) & (pairs.image2 < 20)
    few = PairDirections(*(getattr(pairs, name)[kept] for name in pairs.__slots__))
    found = positions_from_pairs(30, offsets, image, seen, few)
    assert np.isfinite(found.centers[:20]).all() and np.isnan(found.centers[20:]).all()
    placed = position_globally(30, offsets, image, seen, 0, few)
    assert np.isfinite(placed.centers_in_world).all()


def test_without_pairs_the_start_is_random(rng):
    _, _, offsets, image, seen = chain(rng, 30)
    none = PairDirections(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 3)))
    one, other = (position_globally(30, offsets, image, seen, 0, pairs) for pairs in (None, none))
    np.testing.assert_array_equal(one.centers_in_world, other.centers_in_world)
    assert repr(none) == "PairDirections(0 pairs)"
    outside = PairDirections(np.array([0], np.int32), np.array([30], np.int32), np.array([[1.0, 0.0, 0.0]]))
    with pytest.raises(ShapeError, match="image2"):
        position_globally(30, offsets, image, seen, 0, outside)
    unknown = PairDirections(np.array([0], np.int32), np.array([1], np.int32), np.full((1, 3), np.nan))
    with pytest.raises(ConfigError, match="direction_in_world must be finite"):
        position_globally(30, offsets, image, seen, 0, unknown)


def test_values_from_differences_are_zero_at_the_first_node_of_each_component(rng):
    truth = rng.normal(size=(7, 2))
    first, second = np.array([0, 1, 2, 0, 4, 5]), np.array([1, 2, 3, 3, 5, 6])
    component = np.array([0, 0, 0, 0, 1, 1, 1])
    found = solve_laplacian(first, second, component, np.ones(6), truth[second] - truth[first])
    np.testing.assert_allclose(found, truth - truth[[0, 0, 0, 0, 4, 4, 4]], atol=1e-9)
    alone = solve_laplacian(first[:0], second[:0], np.arange(3), np.ones(0), np.zeros((0, 1)))
    np.testing.assert_array_equal(alone, np.zeros((3, 1)))


def test_distinct_keys_are_those_of_numpy(rng):
    for size in (0, 1, 1000):
        keys = rng.integers(-50, 50, size)
        np.testing.assert_array_equal(distinct(keys), np.unique(keys))
