"""What the viewer shows and from where, with known answers."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.viewer.selection import glide, vertical_fov_rad, visible_points


@pytest.mark.parametrize(
    ("max_error_px", "min_track_length", "expected"),
    [
        (9.0, 2, [True, True, True, True]),
        (1.0, 2, [True, True, False, True]),
        (1.0, 3, [False, True, False, True]),
        (0.5, 4, [False, False, False, True]),
    ],
)
def test_visible_points(max_error_px: float, min_track_length: int, expected: list[bool]) -> None:
    error_px, track_length = np.array([0.5, 1.0, 2.0, np.nan]), np.array([2, 3, 9, 4])
    assert visible_points(error_px, track_length, max_error_px, min_track_length).tolist() == expected


def test_no_points_are_no_problem() -> None:
    assert visible_points(np.zeros(0), np.zeros(0, np.int64), 1.0, 2).shape == (0,)


def test_vertical_field_of_view() -> None:
    camera = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 240.0, 319.5, 239.5]))
    assert vertical_fov_rad(camera) == pytest.approx(np.pi / 2)
    wide = Camera(CameraModel.SIMPLE_PINHOLE, 640, 480, np.array([10.0, 319.5, 239.5]))
    assert vertical_fov_rad(wide) == pytest.approx(np.deg2rad(130))


def test_glide_ends_at_the_goal_and_is_halfway_in_the_middle() -> None:
    start = Rigid3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    turn = np.array([0.0, 0.0, 4.0, 0.0, 0.0, 1.0])
    path = glide(start, start @ Rigid3.exp(turn), 10)
    assert len(path) == 10
    np.testing.assert_allclose(path[-1].as_matrix(), (start @ Rigid3.exp(turn)).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(path[4].as_matrix(), (start @ Rigid3.exp(turn / 2)).as_matrix(), atol=1e-12)
    steps = np.linalg.norm(np.diff(path.translation, axis=0), axis=1)
    assert steps[0] < steps[4] > steps[-1]
