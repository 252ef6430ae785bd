"""Minimal solvers against the interpreter, and against the truth that made their input."""

from typing import Any

import numpy as np
import pytest

from epipole.geometry import Rigid3, essential_from_cam2_from_cam1, to_homogeneous
from epipole.solvers import _absolute_pose_kernels as absolute
from epipole.solvers import _five_point_kernels as five_point
from epipole.solvers import _focal_motion_kernels as focal_motion
from epipole.solvers import _more_pose_kernels as more
from epipole.solvers import _two_view_kernels as two_view
from kernel_references import assert_same_as_python, plain_python, python_form, reference_of
from whole import IS_WHOLE, in_whole_run

# Whole powers are multiplied out by the compiler and not by Python; the roots of a polynomial of degree 15 feel that.
POWERS = {"rtol": 1e-7, "of_largest": 1e-7}


def anywhere(rng: np.random.Generator) -> Rigid3:
    return Rigid3.exp(np.concatenate([rng.normal(size=3), 0.6 * rng.normal(size=3)]))


def turned_about_y(rng: np.random.Generator) -> Rigid3:
    return Rigid3.exp(np.array([*rng.normal(size=3), 0.0, rng.uniform(-1, 1), 0.0]))


def seen(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (count, 3))


def unit(rays: np.ndarray) -> np.ndarray:
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def odd_rows(count: int, width: int) -> list[np.ndarray]:
    """Coinciding, collinear, unknown and very large rows."""
    line = np.outer(np.arange(1.0, count + 1), np.ones(width))
    return [
        np.ones((count, width)),
        line,
        np.full((count, width), np.nan),
        1e150 * line,
        np.zeros((count, width)),
    ]


def poses(found: int, out: np.ndarray) -> np.ndarray:
    return out[:found, :12]


def row_of(motion: Rigid3) -> np.ndarray:
    return np.append(motion.rotation.ravel(), motion.translation)


def is_among(found: np.ndarray, truth: np.ndarray, tolerance: float) -> bool:
    """One of the rows is the truth, up to sign."""
    both = np.minimum(np.abs(found - truth).max(axis=1), np.abs(found + truth).max(axis=1))
    return bool(both.min(initial=np.inf) < tolerance)


def shapes(room: Any) -> Any:
    return tuple(map(shapes, room)) if isinstance(room, tuple) else (room.dtype, room.shape)


@pytest.mark.parametrize("trial", range(6 if IS_WHOLE else 2))
@reference_of(absolute.p3p)
def test_p3p(trial: int) -> None:
    rng = np.random.default_rng(trial)
    truth, in_cam = anywhere(rng), seen(rng, 3)
    out, work = np.zeros((4, 12)), absolute.p3p_workspace()
    count, (_, _, found, _) = assert_same_as_python(
        absolute.p3p, unit(in_cam), truth.inverse().apply(in_cam), out, work
    )
    assert is_among(poses(count, found), row_of(truth), 1e-6)
    for rows in odd_rows(3, 3):
        assert_same_as_python(absolute.p3p, unit(in_cam), rows, out, work)
        assert_same_as_python(absolute.p3p, rows, in_cam, out, work)


@in_whole_run
@pytest.mark.parametrize("trial", range(4 if IS_WHOLE else 2))
@reference_of(more.generalized_p3p, more.p4pf, more.upright_p2p)
def test_poses(trial: int) -> None:
    rng = np.random.default_rng(trial)
    truth, in_rig, origins = anywhere(rng), seen(rng, 3), 0.5 * rng.normal(size=(3, 3))
    out, work = np.zeros((8, 13)), more.generalized_p3p_workspace()
    points = truth.inverse().apply(in_rig)
    count, (*_, found, _) = assert_same_as_python(
        more.generalized_p3p, origins, unit(in_rig - origins), points, out, work
    )
    assert is_among(poses(count, found), row_of(truth), 1e-4)
    for rows in odd_rows(3, 3):
        assert_same_as_python(more.generalized_p3p, origins, unit(in_rig - origins), rows, out, work)
        assert_same_as_python(more.generalized_p3p, rows, rows, points, out, work)

    in_cam, work = seen(rng, 4), more.p4pf_workspace()
    points, pixels = truth.inverse().apply(in_cam), 1.7 * in_cam[:, :2] / in_cam[:, 2:]
    count, (*_, found, _) = assert_same_as_python(more.p4pf, pixels, points, out, work)
    assert is_among(found[:count], np.append(row_of(truth), 1.7), 1e-4)
    for rows in odd_rows(4, 3):
        assert_same_as_python(more.p4pf, pixels, rows, out, work)
        assert_same_as_python(more.p4pf, rows[:, :2].copy(), points, out, work)

    truth, in_cam, out = turned_about_y(rng), seen(rng, 2), np.zeros((2, 12))
    points = truth.inverse().apply(in_cam)
    count, (*_, found) = assert_same_as_python(more.upright_p2p, unit(in_cam), points, out)
    assert is_among(poses(count, found), row_of(truth), 1e-8)
    for rows in odd_rows(2, 3):
        assert_same_as_python(more.upright_p2p, unit(in_cam), rows, out)
        assert_same_as_python(more.upright_p2p, rows, points, out)


def normalized(matrix: np.ndarray) -> np.ndarray:
    return matrix.ravel() / np.linalg.norm(matrix)


@in_whole_run
@pytest.mark.parametrize("trial", range(4 if IS_WHOLE else 2))
@reference_of(
    five_point.essential_five_point, two_view.fundamental_seven_point, two_view.homography_four_point
)
def test_two_views(trial: int) -> None:
    rng = np.random.default_rng(trial)
    motion, points = anywhere(rng), seen(rng, 7)
    truth, moved = normalized(essential_from_cam2_from_cam1(motion)), motion.apply(points)
    for solve, count, room, work in (
        (five_point.essential_five_point, 5, (10, 9), five_point.five_point_workspace()),
        (two_view.fundamental_seven_point, 7, (3, 9), two_view.seven_point_workspace()),
    ):
        y1, y2, out = points[:count], moved[:count], np.zeros(room)
        many, (*_, found, _) = assert_same_as_python(solve, y1, y2, out, work)
        lengths = np.linalg.norm(found[:many], axis=1, keepdims=True)
        assert is_among(found[:many] / lengths, truth, 1e-5)
        for rows in odd_rows(count, 3):
            assert_same_as_python(solve, y1, rows, out, work)
            assert_same_as_python(solve, rows, rows, out, work)

    plane = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    x1, out = to_homogeneous(rng.normal(size=(4, 2))), np.zeros(9)
    is_found, (*_, found) = assert_same_as_python(two_view.homography_four_point, x1, x1 @ plane.T, out)
    assert is_found and is_among(normalized(found)[None], normalized(plane), 1e-9)
    for rows in odd_rows(4, 3):
        assert not assert_same_as_python(two_view.homography_four_point, x1, rows, out)[0]
        assert not assert_same_as_python(two_view.homography_four_point, rows, x1, out)[0]


@pytest.mark.parametrize("trial", range(3 if IS_WHOLE else 2))
@reference_of(more.upright_relative_three_point, focal_motion.shared_focal_six_point)
def test_two_views_of_other_cameras(trial: int) -> None:
    rng = np.random.default_rng(trial)
    motion, points, out = turned_about_y(rng), seen(rng, 3), np.zeros((12, 12))
    motion = Rigid3(motion.rotation, motion.translation / np.linalg.norm(motion.translation))
    work = more.upright_relative_workspace()
    solve = more.upright_relative_three_point
    count, (*_, found, _) = assert_same_as_python(solve, points, motion.apply(points), out, work)
    assert is_among(poses(count, found), row_of(motion), 1e-6)
    for rows in odd_rows(3, 3):
        assert_same_as_python(solve, points, rows, out, work)
        assert_same_as_python(solve, rows, rows, out, work)

    motion, points, work = anywhere(rng), seen(rng, 6), focal_motion.shared_focal_workspace()
    x1, x2 = (p / p[:, 2:] * [1.4, 1.4, 1.0] for p in (points, motion.apply(points)))
    room = np.zeros((8, 9)), np.zeros(8)
    solve = focal_motion.shared_focal_six_point
    count, (_, _, essentials, focals, _) = assert_same_as_python(
        solve, x1, x2, *room, work, outputs=(2, 3), **POWERS
    )
    found = np.column_stack(
        [essentials[:count] / np.linalg.norm(essentials[:count], axis=1)[:, None], focals[:count]]
    )
    truth = normalized(essential_from_cam2_from_cam1(motion))
    assert is_among(found, np.append(truth, 1.4), 1e-4) or is_among(found, np.append(-truth, 1.4), 1e-4)
    for rows in odd_rows(6, 3):
        # Rounding decides what is found where nothing is determined.
        count = solve(x1, rows, *room, work)
        assert 0 <= count <= len(room[0]) and np.isfinite(room[0][:count]).all()
    unknown = np.full((6, 3), np.nan)
    count, _ = assert_same_as_python(solve, x1, unknown, *room, work, outputs=())
    assert count == 0


@reference_of(
    absolute.p3p_workspace,
    more.generalized_p3p_workspace,
    more.p4pf_workspace,
    more.upright_relative_workspace,
    five_point.five_point_workspace,
    two_view.seven_point_workspace,
    focal_motion.shared_focal_workspace,
)
def test_rooms_are_of_one_shape() -> None:
    for room in (
        *(absolute.p3p_workspace, more.generalized_p3p_workspace, more.p4pf_workspace),
        *(more.upright_relative_workspace, five_point.five_point_workspace, two_view.seven_point_workspace),
        focal_motion.shared_focal_workspace,
    ):
        with plain_python():
            expected = python_form(room)()
        assert shapes(room()) == shapes(expected)
