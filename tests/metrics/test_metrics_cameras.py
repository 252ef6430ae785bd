"""Camera errors: known displacements, alignment by centers and on a line, missing cameras."""

import numpy as np
import pytest

from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.metrics import align_cameras, camera_errors

TRUTH_FROM_ESTIMATED = Similarity3.exp([3.0, -2.0, 1.0, 0.4, -1.1, 0.7, 0.9])


def cameras_at(centers: np.ndarray, seed: int = 0) -> Rigid3:
    """cams_from_world with these centers and random rotations."""
    rotation = Rotation3.exp(np.random.default_rng(seed).normal(size=(len(centers), 3))).matrix
    return Rigid3(rotation, -(rotation @ centers[:, :, None])[:, :, 0])


def seen_from_estimate(truth: Rigid3) -> Rigid3:
    return TRUTH_FROM_ESTIMATED.inverse().move_cam_from_source(truth)


def assert_similar(found: Similarity3, expected: Similarity3, tolerance: float = 1e-9) -> None:
    assert np.abs((found @ expected.inverse()).log()).max() < tolerance


def on_line(count: int) -> np.ndarray:
    return np.linspace(0, 1, count)[:, None] * [4.0, 1.0, -2.0] + [7.0, 8.0, 9.0]


@pytest.mark.parametrize(
    ("centers", "is_on_line"),
    [
        (np.random.default_rng(1).normal(size=(6, 3)), False),
        (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), False),
        (on_line(2), True),
        (on_line(5), True),
    ],
)
def test_alignment_finds_the_similarity(centers: np.ndarray, is_on_line: bool) -> None:
    truth = cameras_at(centers)
    alignment = align_cameras(seen_from_estimate(truth), truth)
    assert alignment.is_on_line == is_on_line
    assert_similar(alignment.truth_from_estimated, TRUTH_FROM_ESTIMATED)
    errors = camera_errors(seen_from_estimate(truth), truth)
    assert errors.max_position < 1e-9
    assert errors.max_rotation_deg < 1e-6


def test_on_a_line_positions_stay_when_all_rotations_are_off() -> None:
    """A common error of the rotations turns the model around the line, but does not move it off the line."""
    truth = cameras_at(on_line(5))
    wrong = Rigid3.from_matrix(seen_from_estimate(truth).as_matrix())
    centers = wrong.centers()
    off = wrong.rotation @ Rotation3.exp([0.02, -0.01, 0.03]).matrix
    wrong = Rigid3(off, -(off @ centers[:, :, None])[:, :, 0])
    errors = camera_errors(wrong, truth)
    assert errors.max_position < 1e-9
    assert 0.1 < errors.mean_rotation_deg < np.degrees(np.linalg.norm([0.02, -0.01, 0.03])) + 1e-6


def test_a_line_walked_in_the_opposite_direction_is_turned_round() -> None:
    centers = np.linspace(0, 1, 4)[:, None] * [1.0, 0, 0]
    rotation = Rotation3.identity(4).matrix
    truth = Rigid3(rotation, -centers)
    errors = camera_errors(Rigid3(rotation, centers), truth)
    assert errors.max_position < 1e-12
    assert np.allclose(errors.rotation_deg, 180.0)


def test_known_errors_under_a_given_alignment() -> None:
    truth = cameras_at(np.random.default_rng(2).normal(size=(4, 3)))
    alignment = align_cameras(truth, truth)
    shifts = np.array([[0.0, 0, 0], [3, 4, 0], [0, 0, 1], [0, 2, 0]])
    rotations = Rotation3.exp(np.radians([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 5]])).matrix
    rotation = rotations @ truth.rotation
    moved = Rigid3(rotation, -(rotation @ (truth.centers() + shifts)[:, :, None])[:, :, 0])
    errors = camera_errors(moved, truth, alignment)
    assert np.allclose(errors.position, [0, 5, 1, 2], atol=1e-9)
    assert np.allclose(errors.rotation_deg, [0, 1, 2, 5], atol=1e-6)
    assert np.isclose(errors.mean_position, 2) and np.isclose(errors.median_position, 1.5)
    assert np.isclose(errors.max_position, 5) and np.isclose(errors.max_rotation_deg, 5)
    assert np.isclose(errors.mean_rotation_deg, 2) and np.isclose(errors.median_rotation_deg, 1.5)


def test_missing_cameras_are_left_out() -> None:
    truth = cameras_at(np.random.default_rng(3).normal(size=(6, 3)))
    estimated = seen_from_estimate(truth)
    holes = Rigid3(estimated.rotation.copy(), estimated.translation.copy())
    holes.rotation[2], holes.translation[2] = np.nan, np.nan
    errors = camera_errors(holes, truth)
    assert np.flatnonzero(np.isnan(errors.position)).tolist() == [2]
    assert errors.max_position < 1e-9
    assert_similar(errors.alignment.truth_from_estimated, TRUTH_FROM_ESTIMATED)


def test_what_cannot_be_aligned_is_said() -> None:
    truth = cameras_at(np.random.default_rng(4).normal(size=(4, 3)))
    missing = Rigid3(np.full((4, 3, 3), np.nan), np.full((4, 3), np.nan))
    with pytest.raises(DegenerateGeometryError, match="at least 2"):
        align_cameras(missing, truth)
    for count in (2, 5):
        one_place = cameras_at(np.tile([1.0, 2.0, 3.0], (count, 1)))
        with pytest.raises(DegenerateGeometryError):
            align_cameras(one_place, one_place)
    with pytest.raises(ShapeError):
        align_cameras(truth[:3], truth)
