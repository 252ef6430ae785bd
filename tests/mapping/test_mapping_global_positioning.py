"""Positions of all cameras and points from directions: known answers, outliers, and the equations written out densely."""

import numpy as np
import pytest

from epipole.errors import ShapeError
from epipole.geometry import align_points
from epipole.mapping import MatchComponents, choose_tracks, position_globally
from epipole.mapping import _track_kernels as track_kernels
from epipole.mapping.positions import _positioning_kernels as kernels
from epipole.mapping.positions import global_positioning
from kernel_references import assert_same_as_python, record_calls, reference_of
from mapping_graphs import graph_of_rotations


def walk(rng, num_images=20, num_points=300, noise_rad=0.0, wrong=0.0):
    """Cameras around a cloud of points, each point seen by three to six neighbors; true centers and the directions."""
    turn = np.linspace(0, 2 * np.pi, num_images, endpoint=False)
    centers = np.stack([4 * np.cos(turn), 4 * np.sin(turn), rng.normal(0, 0.3, num_images)], axis=1)
    points = rng.uniform(-1.5, 1.5, (num_points, 3))
    lengths = rng.integers(3, 7, num_points)
    image = np.concatenate([(rng.integers(num_images) + np.arange(k)) % num_images for k in lengths])
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    ray = points[np.repeat(np.arange(num_points), lengths)] - centers[image]
    direction = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    direction += noise_rad * rng.normal(size=direction.shape)
    is_wrong = rng.random(len(image)) < wrong
    direction[is_wrong] = rng.normal(size=(int(is_wrong.sum()), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return centers, offsets, image.astype(np.int32), direction, is_wrong


def center_errors(found, truth):
    moved = align_points(found.centers_in_world, truth).apply(found.centers_in_world)
    return np.linalg.norm(moved - truth, axis=1)


@pytest.mark.parametrize("seed", range(5))
def test_exact_directions_give_exact_positions_from_any_start(rng, seed):
    centers, offsets, image, direction, _ = walk(rng)
    found = position_globally(20, offsets, image, direction, seed)
    assert center_errors(found, centers).max() < 0.02
    assert np.median(found.angles_rad) < 2e-3


def test_wrong_directions_have_little_influence_and_large_angles(rng):
    centers, offsets, image, direction, is_wrong = walk(rng, noise_rad=0.002, wrong=0.1)
    found = position_globally(20, offsets, image, direction)
    assert np.median(center_errors(found, centers)) < 0.15  # of a ring of radius four
    assert np.median(found.angles_rad[~is_wrong]) < 0.02 < 0.2 < np.median(found.angles_rad[is_wrong])


def test_a_rotated_world_gives_the_same_angles(rng):
    _, offsets, image, direction, _ = walk(rng, noise_rad=0.01)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    one = position_globally(20, offsets, image, direction)
    other = position_globally(20, offsets, image, direction @ quarter.T)
    assert np.median(np.abs(one.angles_rad - other.angles_rad)) < 1e-3


def test_the_same_seed_gives_the_same_positions(rng):
    _, offsets, image, direction, _ = walk(rng, noise_rad=0.01)
    one, other = (position_globally(20, offsets, image, direction, 3) for _ in range(2))
    np.testing.assert_array_equal(one.centers_in_world, other.centers_in_world)


def test_nothing_in_gives_nothing_out():
    none = np.zeros(0, np.int32)
    found = position_globally(2, np.zeros(1, np.int64), none, np.zeros((0, 3)))
    assert len(found.points_in_world) == 0 and len(found.centers_in_world) == 2
    assert "2 cameras, 0 points" in repr(found)


def test_images_that_do_not_exist_are_refused(rng):
    _, offsets, image, direction, _ = walk(rng)
    with pytest.raises(ShapeError, match="image"):
        position_globally(5, offsets, image, direction)
    with pytest.raises(ShapeError, match="directions_in_world"):
        position_globally(20, offsets, image, direction[:-1])


def dense_step(seen, centers, points, inverse, weight, damping):
    """The damped Gauss-Newton step of all unknowns at once: centers, points, inverse distances.

    The kernels damp each block where it is eliminated: the inverse distance by its own square, a point by the diagonal
    that is left, and here nothing else, so that the step is compared at a damping of zero with a fixed first camera.
    """
    n, t, r = len(centers), len(points), len(inverse)
    point = np.repeat(np.arange(t), np.diff(seen.offsets))
    J, residual = np.zeros((3 * r, 3 * n + 3 * t + r)), np.zeros(3 * r)
    for k in range(r):
        rows, root = slice(3 * k, 3 * k + 3), np.sqrt(weight[k])
        u = points[point[k]] - centers[seen.image[k]]
        residual[rows] = root * (seen.direction[k] - inverse[k] * u)
        J[rows, 3 * seen.image[k] : 3 * seen.image[k] + 3] = root * inverse[k] * np.eye(3)
        at = 3 * n + 3 * point[k]
        J[rows, at : at + 3] = -root * inverse[k] * np.eye(3)
        J[rows, 3 * n + 3 * t + k] = -root * u
    H, g = J.T @ J, -J.T @ residual
    return H, g


@reference_of(kernels.reduce_points, kernels.find_blocks, kernels.substitute_back)
def test_elimination_and_back_substitution_solve_the_whole_system(rng):
    n = 4
    centers, offsets, image, direction, _ = walk(rng, n, 12, noise_rad=0.05)
    lengths = np.minimum(np.diff(offsets), n)
    kept_rows = np.concatenate([np.arange(a, a + k) for a, k in zip(offsets[:-1], lengths)])
    offsets, image = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64), image[kept_rows]
    seen = kernels.Directions(offsets, image.astype(np.int64), np.ascontiguousarray(direction[kept_rows]))
    points, inverse = rng.normal(size=(12, 3)), rng.uniform(0.2, 0.4, len(image))
    weight = rng.uniform(0.5, 1.0, len(image))
    row_start = np.cumsum(np.arange(n + 1)).astype(np.int64)
    column = np.concatenate([np.arange(i + 1) for i in range(n)]).astype(np.int64)
    r = len(image)
    kept = kernels.Eliminated(*(np.empty(s) for s in ((r, 6), (r, 3), (12, 6), (12, 3))))
    blocks, gradient, half = np.zeros((len(column), 3, 3)), np.zeros((n, 3)), np.empty((n, 3, 3))
    count = kernels.find_blocks(seen, row_start, column, np.empty(0, np.int32))
    assert count == sum(k * (k + 1) // 2 for k in lengths)
    found = (seen, row_start, column, np.empty(count, np.int32))
    _, (*_, block_of_pair) = assert_same_as_python(kernels.find_blocks, *found)
    diagonal = row_start[1:] - 1
    given = (
        seen,
        centers,
        points,
        inverse,
        weight,
        0.0,
        kept,
        diagonal,
        block_of_pair,
        blocks,
        gradient,
        half,
    )
    _, changed = assert_same_as_python(kernels.reduce_points, *given, rtol=1e-9, atol=1e-12)
    kept, blocks, gradient = changed[6], changed[9], changed[10]
    H, g = dense_step(seen, centers, points, inverse, weight, 0.0)
    reduced = H[: 3 * n, : 3 * n] - H[: 3 * n, 3 * n :] @ np.linalg.solve(
        H[3 * n :, 3 * n :], H[3 * n :, : 3 * n]
    )
    right = g[: 3 * n] - H[: 3 * n, 3 * n :] @ np.linalg.solve(H[3 * n :, 3 * n :], g[3 * n :])
    found = np.zeros((3 * n, 3 * n))
    for i in range(n):
        for at in range(row_start[i], row_start[i + 1]):
            found[3 * i : 3 * i + 3, 3 * column[at] : 3 * column[at] + 3] = blocks[at]
    lower = np.tril(np.ones((n, n))).repeat(3, axis=0).repeat(3, axis=1) > 0
    np.testing.assert_allclose(found[lower], reduced[lower], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(gradient.ravel(), right, rtol=1e-5, atol=1e-7)
    step = np.concatenate([np.zeros(3), np.linalg.solve(reduced[3:, 3:], right[3:])]).reshape(n, 3)
    rest = np.linalg.solve(H[3 * n :, 3 * n :], g[3 * n :] - H[3 * n :, : 3 * n] @ step.ravel())
    moved, moved_inverse = np.empty_like(points), np.empty_like(inverse)
    _, changed = assert_same_as_python(
        kernels.substitute_back,
        seen,
        centers,
        points,
        inverse,
        0.0,
        step,
        kept,
        moved,
        moved_inverse,
        rtol=1e-9,
        atol=1e-12,
    )
    np.testing.assert_allclose(changed[7] - points, rest[:36].reshape(-1, 3), rtol=1e-4, atol=1e-5)
    expected = np.maximum(inverse + rest[36:], kernels.LEAST_INVERSE_DISTANCE)
    np.testing.assert_allclose(changed[8], expected, rtol=1e-4, atol=1e-5)


@reference_of(kernels.refine_points)
def test_refining_lowers_the_cost_of_every_point_and_leaves_the_best_inverse_distances(rng):
    centers, offsets, image, direction, _ = walk(rng, 6, 20, noise_rad=0.02, wrong=0.1)
    seen = kernels.Directions(offsets, image.astype(np.int64), np.ascontiguousarray(direction))
    points, r = rng.normal(size=(20, 3)), len(image)
    kept = kernels.Eliminated(*(np.empty(s) for s in ((r, 6), (r, 3), (20, 6), (20, 3))))
    given = (seen, centers, points.copy(), np.ones(r), 0.1, kept, np.empty(3))
    _, changed = assert_same_as_python(kernels.refine_points, *given, rtol=1e-8, atol=1e-10)
    refined, inverse = changed[2:4]
    point = np.repeat(np.arange(20), np.diff(offsets))

    def costs(at, inverse=None):
        u = at[point] - centers[seen.image]
        best = np.maximum((u * direction).sum(axis=1) / (u**2).sum(axis=1), kernels.LEAST_INVERSE_DISTANCE)
        inverse = best if inverse is None else inverse
        size = np.linalg.norm(direction - inverse[:, None] * u, axis=1)
        return np.bincount(point, np.where(size <= 0.1, size**2, 0.2 * size - 0.01)), best

    (before, _), (after, best) = costs(points), costs(refined)
    assert (after <= before + 1e-12).all() and (after < 0.5 * before).mean() > 0.5
    np.testing.assert_allclose(inverse, best)


@reference_of(kernels.robust_cost)
def test_the_cost_is_hubers(rng, monkeypatch):
    centers, offsets, image, direction, _ = walk(rng, 5, 20, wrong=0.3)
    calls = record_calls(monkeypatch, global_positioning.kernels, kernels.robust_cost)
    position_globally(5, offsets, image, direction)
    arguments = calls[0]
    cost, changed = assert_same_as_python(kernels.robust_cost, *arguments, rtol=1e-9, atol=1e-12)
    seen, centers, points, inverse, scale = arguments[:5]
    point = np.repeat(np.arange(20), np.diff(offsets))
    size = np.linalg.norm(seen.direction - inverse[:, None] * (points[point] - centers[seen.image]), axis=1)
    huber = np.where(size <= scale, size**2, 2 * scale * size - scale**2)
    np.testing.assert_allclose(cost, huber.sum())
    np.testing.assert_allclose(changed[5], np.minimum(1.0, scale / size))


def components_of(tracks):
    """Components from lists of images; every keypoint has the number of its component."""
    image = np.concatenate([np.array(t) for t in tracks]).astype(np.int32)
    number = np.repeat(np.arange(len(tracks)), [len(t) for t in tracks]).astype(np.int32)
    return MatchComponents(
        np.concatenate([[0], np.cumsum([len(t) for t in tracks])]).astype(np.int64), image, number
    )


@reference_of(track_kernels.cover_images)
def test_the_longest_tracks_are_chosen_until_every_image_has_enough(rng):
    tracks = [[0, 1, 2], [0, 1, 2, 3], [0, 1], [2, 3, 4], [0, 1, 2]]
    rows = choose_tracks(components_of(tracks), np.ones(5, bool), 1)
    assert sorted(set(np.searchsorted([3, 7, 9, 12, 15], rows, side="right"))) == [1, 3]
    everything = choose_tracks(components_of(tracks), np.ones(5, bool), 99)
    assert len(everything) == 13  # all but the track in two images
    without = choose_tracks(components_of(tracks), np.array([1, 1, 0, 1, 1], bool), 99)
    assert len(without) == 3 and 5 not in without  # images 0, 1 and 3 of the second
    many = [list(rng.choice(30, rng.integers(2, 8), replace=False)) for _ in range(200)]
    parts, member = components_of(many), rng.random(30) < 0.8
    count, chosen = np.zeros(30, np.int64), np.zeros(200, bool)
    assert_same_as_python(
        track_kernels.cover_images, parts.offsets, parts.image, member, np.arange(200), 5, count, chosen
    )


def test_pairs_that_the_longest_tracks_do_not_connect_get_tracks_of_their_own(rng):
    """Two groups of images with long tracks inside, and short tracks between images 2 and 3."""
    inside = [[0, 1, 2]] * 8 + [[3, 4, 5]] * 8
    across = [[1, 2, 3]] * 6
    parts = components_of([*inside, *across])
    graph = graph_of_rotations([(2, 3), (0, 1)], np.tile(np.eye(3), (2, 1, 1)), [22, 8])
    without = choose_tracks(parts, np.ones(6, bool), 4)
    assert not np.isin(parts.keypoint[without], np.arange(16, 22)).any()
    rows = choose_tracks(parts, np.ones(6, bool), 4, graph, 5)
    assert np.isin(np.arange(16, 22), parts.keypoint[rows]).sum() == 5


def test_tracks_of_images_that_do_not_exist_are_refused():
    with pytest.raises(ShapeError, match="image"):
        choose_tracks(components_of([[0, 1, 7]]), np.ones(3, bool), 5)
