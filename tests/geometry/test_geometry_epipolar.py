"""Two-view algebra at its edges: known answers, no motion, no matches, NaN."""

import numpy as np
import pytest

from epipole.errors import ShapeError
from epipole.geometry import (
    Rigid3,
    choose_by_cheirality,
    decompose_essential_matrix,
    epipolar_lines,
    epipoles,
    essential_from_cam2_from_cam1,
    fundamental_from_essential,
    sampson_error,
)

SIDEWAYS = Rigid3(np.eye(3), np.array([-1.0, 0.0, 0.0]))
RECTIFIED = np.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def test_a_rectified_pair_has_the_textbook_matrix() -> None:
    np.testing.assert_array_equal(essential_from_cam2_from_cam1(SIDEWAYS), RECTIFIED)
    # The epipolar line of a pixel is its own row, both epipoles lie at infinity along x.
    np.testing.assert_allclose(
        np.abs(epipolar_lines(RECTIFIED, [[3.0, 7.0], [0.0, -2.0]])), [[0, 1, 7], [0, 1, 2]]
    )
    epipole1, epipole2 = epipoles(RECTIFIED)
    np.testing.assert_allclose(np.abs([epipole1, epipole2]), [[1, 0, 0], [1, 0, 0]], atol=1e-15)
    # Rows that differ by d: each pixel moves d / 2.
    np.testing.assert_allclose(sampson_error(RECTIFIED, [[5.0, 7.0]], [[2.0, 10.0]]), 3 / np.sqrt(2))


def test_no_translation_has_no_epipolar_geometry() -> None:
    rotating = Rigid3.exp([0.0, 0, 0, 0.1, 0.2, 0.3])
    zero = essential_from_cam2_from_cam1(rotating)
    np.testing.assert_array_equal(zero, np.zeros((3, 3)))
    assert np.isnan(sampson_error(zero, np.ones((2, 2)), np.ones((2, 2)))).all()
    assert np.isnan(epipolar_lines(zero, np.ones((2, 2)))).all()


def test_batches_of_motions(rng: np.random.Generator) -> None:
    motions = Rigid3.exp(rng.normal(size=(4, 2, 6)))
    essential = essential_from_cam2_from_cam1(motions)
    K = np.diag([500.0, 500.0, 1.0])
    fundamental = fundamental_from_essential(essential, K, np.broadcast_to(K, (4, 2, 3, 3)))
    assert essential.shape == fundamental.shape == (4, 2, 3, 3)
    np.testing.assert_allclose(essential[3, 1], essential_from_cam2_from_cam1(motions[3, 1]))
    np.testing.assert_allclose(fundamental[3, 1], fundamental_from_essential(essential[3, 1], K, K))


def test_no_match_and_one_match() -> None:
    none = np.zeros((0, 2))
    assert epipolar_lines(RECTIFIED, none).shape == (0, 3)
    assert sampson_error(RECTIFIED, none, none).shape == (0,)
    candidates = decompose_essential_matrix(RECTIFIED)
    index, in_front, points = choose_by_cheirality(candidates, np.zeros((0, 3)), np.zeros((0, 3)))
    assert index == 0 and in_front.shape == (0,) and points.shape == (0, 3)
    index, in_front, points = choose_by_cheirality(candidates, [[0.0, 0, 1]], [[-0.5, 0, 1]])
    np.testing.assert_allclose(candidates[index].as_matrix(), SIDEWAYS.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(points, [[0.0, 0, 2]])
    assert in_front.all()


def test_no_candidate_is_chosen_from_none() -> None:
    index, in_front, points = choose_by_cheirality(Rigid3.identity(0), np.ones((2, 3)), np.ones((2, 3)))
    assert index == -1 and not in_front.any() and np.isnan(points).all()


def test_nan_matches_are_never_in_front() -> None:
    rays1, rays2 = np.array([[0.0, 0, 1], [np.nan, 0, 1]]), np.array([[-0.5, 0, 1], [0.0, 0, 1]])
    _, in_front, points = choose_by_cheirality(decompose_essential_matrix(RECTIFIED), rays1, rays2)
    np.testing.assert_array_equal(in_front, [True, False])
    assert np.isfinite(points[0]).all() and np.isnan(points[1]).all()
    found = sampson_error(RECTIFIED, [[np.nan, 0.0], [0.0, 0.0]], [[0.0, 0.0], [1.0, 0.0]])
    assert np.isnan(found[0]) and found[1] == 0.0


def test_the_error_at_both_epipoles_is_not_a_number() -> None:
    forward = essential_from_cam2_from_cam1(Rigid3(np.eye(3), np.array([0.0, 0.0, 1.0])))
    found = sampson_error(forward, [[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0], [2.0, 0.0]])
    assert np.isnan(found[0]) and found[1] == pytest.approx(0.0)
    assert np.isnan(epipolar_lines(forward, [[0.0, 0.0]])).all()


def test_decomposition_of_a_noisy_matrix_gives_rotations(rng: np.random.Generator) -> None:
    for _ in range(20):
        candidates = decompose_essential_matrix(rng.normal(size=(3, 3)))
        np.testing.assert_allclose(
            candidates.rotation @ np.swapaxes(candidates.rotation, -1, -2), [np.eye(3)] * 4, atol=1e-14
        )
        np.testing.assert_allclose(np.linalg.det(candidates.rotation), 1.0)
        np.testing.assert_allclose(candidates.translation[::2], -candidates.translation[1::2])


@pytest.mark.parametrize(
    "call",
    [
        lambda many: decompose_essential_matrix(many),
        lambda many: epipoles(many),
        lambda many: epipolar_lines(many, np.zeros((3, 2))),
        lambda many: sampson_error(many, np.zeros((3, 2)), np.zeros((3, 2))),
    ],
)
def test_one_matrix_is_not_a_batch(call: object) -> None:
    with pytest.raises(ShapeError, match=r"must be one \(3, 3\) matrix, got \(3, 3, 3\)"):
        call(np.ones((3, 3, 3)))  # type: ignore[operator]
    with pytest.raises(ShapeError, match=r"must have shape"):
        call(np.ones((3, 4)))  # type: ignore[operator]


def test_lists_of_unequal_length() -> None:
    with pytest.raises(ShapeError, match="pixels1 has 2, pixels2 has 3"):
        sampson_error(RECTIFIED, np.zeros((2, 2)), np.zeros((3, 2)))
    with pytest.raises(ShapeError, match="rays1 has 2, rays2 has 3"):
        choose_by_cheirality(decompose_essential_matrix(RECTIFIED), np.zeros((2, 3)), np.zeros((3, 3)))
