"""Areas under recall curves and relative poses of all pairs: answers worked out by hand."""

import numpy as np
import pytest

from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.metrics import area_under_recall, relative_pose_auc, relative_pose_errors_deg


def cameras(centers: np.ndarray, rotations_deg: np.ndarray) -> Rigid3:
    rotation = Rotation3.exp(np.radians(rotations_deg)).matrix
    return Rigid3(rotation, -(rotation @ centers[:, :, None])[:, :, 0])


SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


def test_area_of_one_error_is_a_triangle_and_a_rectangle() -> None:
    # recall climbs from 0 to 1 over [0, 2] and stays: (1 + 2) / 4
    assert np.allclose(area_under_recall([2.0], [4.0, 1.0]), [0.75, 0.0])


def test_area_of_several_errors() -> None:
    # (0, 0) (1, 1/4) (2, 1/2) (3, 3/4), level to 4; the fourth is missing
    area = 0.125 + 0.375 + 0.625 + 0.75
    assert np.allclose(area_under_recall([3.0, 1.0, np.inf, 2.0], [4.0]), area / 4)


def test_area_limits() -> None:
    assert np.allclose(area_under_recall(np.zeros(5), [1.0, 3.0]), 1.0)
    assert np.allclose(area_under_recall(np.full(5, np.inf), [1.0, 3.0]), 0.0)


def test_area_refuses_what_has_no_meaning() -> None:
    with pytest.raises(ShapeError):
        area_under_recall([], [1.0])
    with pytest.raises(ShapeError):
        area_under_recall([np.nan], [1.0])
    with pytest.raises(ConfigError):
        area_under_recall([1.0], [0.0])


def test_relative_poses_do_not_depend_on_the_coordinates() -> None:
    truth = cameras(
        np.random.default_rng(0).normal(size=(7, 3)), np.random.default_rng(1).normal(size=(7, 3)) * 40
    )
    moved = Similarity3.exp([1.0, 2, 3, 0.3, 0.2, 0.1, -1.5]).move_cam_from_source(truth)
    assert relative_pose_errors_deg(moved, truth, np.ones(7, bool)).max() < 1e-6
    assert np.allclose(relative_pose_auc(moved, truth, np.ones(7, bool)), 1.0, atol=1e-6)


def test_rotation_error_of_one_camera_touches_its_pairs_alone() -> None:
    truth = cameras(SQUARE, np.zeros((4, 3)))
    rotated = cameras(SQUARE, np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 2.0]]))
    errors = relative_pose_errors_deg(rotated, truth, np.ones(4, bool))
    # pairs in order 01 02 03 12 13 23
    assert np.allclose(errors, [0, 0, 2, 0, 2, 2], atol=1e-6)


def test_direction_error_counts_when_it_is_the_greater() -> None:
    truth = cameras(np.array([[0.0, 0, 0], [1, 0, 0]]), np.zeros((2, 3)))
    angle = np.radians(3.0)
    estimated = cameras(
        np.array([[0.0, 0, 0], [5 * np.cos(angle), 5 * np.sin(angle), 0]]), np.array([[0.0] * 3, [0, 1.0, 0]])
    )
    rotated_direction = Rotation3.exp([0.0, np.radians(1.0), 0]).apply([np.cos(angle), np.sin(angle), 0])
    expected = np.degrees(np.arccos(rotated_direction[0]))
    assert np.allclose(relative_pose_errors_deg(estimated, truth, np.ones(2, bool)), expected, atol=1e-6)
    backwards = cameras(np.array([[0.0, 0, 0], [-1, 0, 0]]), np.zeros((2, 3)))
    assert np.allclose(relative_pose_errors_deg(backwards, truth, np.ones(2, bool)), 180.0)


def test_pairs_without_a_true_baseline_count_by_rotation() -> None:
    centers = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0]])
    truth = cameras(centers, np.zeros((3, 3)))
    estimated = cameras(np.array([[0.0, 0, 0], [0, 0.1, 0], [1, 0, 0]]), np.zeros((3, 3)))
    errors = relative_pose_errors_deg(estimated, truth, np.ones(3, bool))
    assert errors[0] < 1e-6 and errors[2] > 1
    merged = relative_pose_errors_deg(truth, estimated, np.ones(3, bool))
    assert np.isclose(merged[0], 180.0)


def test_unregistered_pairs_are_infinite() -> None:
    truth = cameras(SQUARE, np.zeros((4, 3)))
    estimated = Rigid3(truth.rotation.copy(), truth.translation.copy())
    estimated.rotation[3], estimated.translation[3] = np.nan, np.nan
    mask = np.array([True, True, True, False])
    errors = relative_pose_errors_deg(estimated, truth, mask)
    assert np.isinf(errors).tolist() == [False, False, True, False, True, True]
    assert np.allclose(relative_pose_auc(estimated, truth, mask, (1, 3, 5)), 0.5, atol=1e-6)


def test_masks_of_another_length_are_refused() -> None:
    truth = cameras(SQUARE, np.zeros((4, 3)))
    with pytest.raises(ShapeError):
        relative_pose_auc(truth, truth, np.ones(3, bool))
