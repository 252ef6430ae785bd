"""Minimal and linear solvers find the truth in exact data, and say so when there is none."""

import numpy as np
import pytest

from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, essential_from_cam2_from_cam1, from_homogeneous, to_homogeneous
from epipole.solvers import (
    solve_essential_five_point,
    solve_fundamental_eight_point,
    solve_fundamental_seven_point,
    solve_homography_dlt,
    solve_homography_four_point,
)


def random_motion(rng):
    motion = Rigid3.exp(np.concatenate([rng.normal(size=3), 0.3 * rng.normal(size=3)]))
    return Rigid3(motion.rotation, motion.translation / np.linalg.norm(motion.translation))


def points_before_camera(rng, count):
    return rng.uniform(-1, 1, (count, 3)) * [2, 2, 1] + [0, 0, 4]


def distance_up_to_sign(found, truth):
    found, truth = found / np.linalg.norm(found), truth / np.linalg.norm(truth)
    return min(np.abs(found - truth).max(), np.abs(found + truth).max())


def test_five_point_contains_the_truth_and_satisfies_its_constraints(rng):
    missed = 0
    for _ in range(100):
        motion, points = random_motion(rng), points_before_camera(rng, 5)
        found = solve_essential_five_point(points, motion.apply(points))
        truth = essential_from_cam2_from_cam1(motion)
        missed += min((distance_up_to_sign(e, truth) for e in found), default=1.0) > 1e-6
        for e in found:
            np.testing.assert_allclose(np.linalg.svd(e, compute_uv=False), [0.5**0.5, 0.5**0.5, 0], atol=1e-5)
    assert missed <= 1


def test_five_point_rejects_a_wrong_shape():
    with pytest.raises(ShapeError):
        solve_essential_five_point(np.zeros((4, 3)), np.zeros((4, 3)))


def test_seven_and_eight_point_contain_the_truth(rng):
    K = np.array([[800.0, 0, 320], [0, 790, 240], [0, 0, 1]])
    for _ in range(30):
        motion, points = random_motion(rng), points_before_camera(rng, 12)
        x1, x2 = from_homogeneous(points @ K.T), from_homogeneous(motion.apply(points) @ K.T)
        inverse = np.linalg.inv(K)
        truth = inverse.T @ essential_from_cam2_from_cam1(motion) @ inverse
        sevens = solve_fundamental_seven_point(x1[:7], x2[:7])
        assert 1 <= len(sevens) <= 3
        assert min(distance_up_to_sign(f, truth) for f in sevens) < 1e-6
        assert distance_up_to_sign(solve_fundamental_eight_point(x1, x2), truth) < 1e-6
        assert np.allclose([np.linalg.det(f / np.linalg.norm(f)) for f in sevens], 0, atol=1e-9)


def test_eight_point_says_that_a_plane_has_many_solutions(rng):
    x1 = rng.uniform(0, 500, (20, 2))
    H = np.eye(3) + 0.01 * rng.normal(size=(3, 3)) * [[1, 1, 10], [1, 1, 10], [1e-3, 1e-3, 0]]
    with pytest.raises(DegenerateGeometryError):
        solve_fundamental_eight_point(x1, from_homogeneous(to_homogeneous(x1) @ H.T))


def test_homography_of_four_points_and_of_many(rng):
    for _ in range(30):
        H = np.eye(3) + 0.05 * rng.normal(size=(3, 3)) * [[1, 1, 100], [1, 1, 100], [1e-3, 1e-3, 0]]
        x1 = rng.uniform(0, 600, (15, 2))
        x2 = from_homogeneous(to_homogeneous(x1) @ H.T)
        assert distance_up_to_sign(solve_homography_four_point(x1[:4], x2[:4])[0], H) < 1e-7
        assert distance_up_to_sign(solve_homography_dlt(x1, x2), H) < 1e-7


def test_homography_of_collinear_points_is_none():
    line = np.stack([np.arange(4.0), 2 * np.arange(4.0)], axis=1)
    assert len(solve_homography_four_point(line, line)) == 0
    with pytest.raises(DegenerateGeometryError):
        solve_homography_dlt(np.stack([np.arange(9.0)] * 2, axis=1), np.stack([np.arange(9.0)] * 2, axis=1))
