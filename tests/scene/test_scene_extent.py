"""The box and the radius of a scene, and frusta to draw in it, with known answers."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.scene import extent_of, frustum_corners_in_cam, frustum_size
from epipole.scene.extent import WIDEST_HALF_ANGLE_RAD

NONE = np.zeros((0, 3))


def ball(n: int = 4000) -> np.ndarray:
    """Points evenly spread in the ball of radius 2 around (1, 2, 3)."""
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return 2.0 * np.cbrt(rng.random((n, 1))) * directions + (1.0, 2.0, 3.0)


def test_radius_reaches_the_share_that_is_asked_for() -> None:
    # A share p of the volume lies within the cube root of p of the radius.
    for percent in (50.0, 95.0):
        extent = extent_of(ball(), NONE, percent)
        np.testing.assert_allclose(extent.focus, (1, 2, 3), atol=0.1)
        assert extent.radius == pytest.approx(2.0 * np.cbrt(percent / 100), rel=0.03)


def test_strays_and_unknown_points_change_little() -> None:
    points = ball()
    strays = np.concatenate([points, np.full((20, 3), 1e6), np.full((9, 3), np.nan), [[np.inf, 0, 0]]])
    clean, found = extent_of(points, NONE, 95.0), extent_of(strays, NONE, 95.0)
    assert found.radius == pytest.approx(clean.radius, rel=0.02)
    np.testing.assert_allclose(found.low, clean.low, atol=0.3)
    mask = found.contains(strays)
    assert mask[: len(points)].all() and not mask[len(points) :].any()


def test_every_camera_is_inside_and_unplaced_ones_do_not_count() -> None:
    centers = np.array([[30.0, 0, 0], [0, -9.0, 0], [np.nan] * 3])
    extent = extent_of(ball(), centers, 95.0)
    assert extent.contains(centers).tolist() == [True, True, False]
    assert extent.radius > 25.0


def test_scale_and_place_of_the_world_carry_over() -> None:
    points, centers = ball(500), ball(8)
    before, after = extent_of(points, centers, 90.0), extent_of(100 * points + 7, 100 * centers + 7, 90.0)
    assert after.radius == pytest.approx(100 * before.radius)
    for name in ("low", "high", "focus"):
        np.testing.assert_allclose(getattr(after, name), 100 * getattr(before, name) + 7)


def test_nothing_one_point_and_cameras_alone() -> None:
    empty = extent_of(NONE, NONE, 95.0)
    assert empty.radius == 1.0 and (empty.low == -1).all() and (empty.high == 1).all()
    one = extent_of(np.array([[5.0, 5.0, 5.0]]), NONE, 95.0)
    assert one.radius == 1.0 and (one.focus == 5).all() and (one.high > one.low).all()
    pair = extent_of(NONE, np.array([[0.0, 0, 0], [4.0, 0, 0]]), 95.0)
    np.testing.assert_allclose(pair.focus, [2.0, 0, 0])
    assert pair.radius == pytest.approx(2.0)


def test_frusta_are_half_as_large_as_the_gaps_within_bounds() -> None:
    row = np.stack([np.arange(10.0), np.zeros(10), np.zeros(10)], axis=1)
    assert frustum_size(row, 0.1, 2.0) == pytest.approx(0.5)
    assert frustum_size(row, 0.1, 0.2) == 0.2
    assert frustum_size(row, 3.0, 4.0) == 3.0
    assert frustum_size(row[:1], 0.1, 2.0) == frustum_size(NONE, 0.1, 2.0) == 2.0


def test_frustum_corners_project_to_the_pictures_corners() -> None:
    camera = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 510.0, 300.0, 250.0]))
    corners = frustum_corners_in_cam(camera.K, camera.width, camera.height)
    expected = [[-0.5, -0.5], [639.5, -0.5], [639.5, 479.5], [-0.5, 479.5]]
    np.testing.assert_allclose(camera.project(corners), expected)


def test_a_very_wide_frustum_is_bounded() -> None:
    K = np.array([[10.0, 0, 319.5], [0, 10.0, 239.5], [0, 0, 1]])
    corners = frustum_corners_in_cam(K, 640, 480)
    assert np.abs(corners[:, :2]).max() == pytest.approx(np.tan(WIDEST_HALF_ANGLE_RAD))
