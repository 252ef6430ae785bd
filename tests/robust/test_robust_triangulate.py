"""Triangulation: optimal in two views, robust in many, and what cannot be triangulated."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from epipole import _parallel
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.robust import PointReason, point_covariances, triangulate_points

CAMERA = Camera(CameraModel.PINHOLE, 1280, 960, np.array([800.0, 800.0, 639.5, 479.5]))
LENS = Camera(CameraModel.RADIAL, 1280, 960, np.array([700.0, 650.0, 470.0, -0.08, 0.01]))
PAIR = Rigid3.exp(np.array([[0.1, 0, 0, 0, 0.05, 0], [-1, 0.1, 0.05, 0.02, 0.1, 0.0]]))


def seen_by(cams, cameras, points, noise_px, rng):
    exact = np.stack([camera.project(cams[k].apply(points)) for k, camera in enumerate(cameras)])
    return exact + noise_px * rng.normal(size=exact.shape)


def some_points(rng, count):
    return rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (count, 3))


@pytest.mark.parametrize("cameras", [[CAMERA, CAMERA], [LENS, CAMERA]])
def test_two_exact_views_give_the_point(rng, cameras):
    points = some_points(rng, 50)
    found = triangulate_points(PAIR, cameras, seen_by(PAIR, cameras, points, 0.0, rng))
    assert (found.reason == PointReason.OK).all() and found.inlier_mask.all()
    np.testing.assert_allclose(found.points_in_world, points, atol=1e-8)
    np.testing.assert_allclose(found.errors_px, 0.0, atol=1e-8)


def test_two_views_minimize_the_reprojection_error(rng):
    points = some_points(rng, 40)
    pixels = seen_by(PAIR, [CAMERA, CAMERA], points, 2.0, rng)
    found = triangulate_points(PAIR, CAMERA, pixels)

    def residuals(x, j):
        return np.concatenate([CAMERA.project(PAIR[k].apply(x[None]))[0] - pixels[k, j] for k in range(2)])

    for j in range(len(points)):
        best = least_squares(residuals, points[j], args=(j,), xtol=1e-12, ftol=1e-12).x
        np.testing.assert_allclose(found.points_in_world[j], best, rtol=2e-5, atol=2e-5)
        rms = np.sqrt((residuals(best, j) ** 2).mean())
        np.testing.assert_allclose(found.errors_px[j], rms, rtol=1e-3)


def test_many_views_leave_wrong_pixels_out(rng):
    cams = Rigid3.exp(
        np.column_stack(
            [np.linspace(-1, 1, 6), rng.normal(size=(6, 2)) * 0.1, 0.05 * rng.normal(size=(6, 3))]
        )
    )
    points = some_points(rng, 300)
    cameras = [CAMERA, LENS] * 3
    pixels = seen_by(cams, cameras, points, 0.7, rng)
    pixels[2, ::3] += 60.0
    pixels[4, ::5] = np.nan
    found = triangulate_points(cams, cameras, pixels, max_error_px=4.0)
    assert (found.reason == PointReason.OK).mean() > 0.99
    assert not found.inlier_mask[2, ::3].any() and not found.inlier_mask[4, ::5].any()
    errors = np.linalg.norm(found.points_in_world - points, axis=1)
    assert np.median(errors) < 0.03 and np.percentile(errors, 95) < 0.12
    covariances = point_covariances(cams, cameras, found.points_in_world, found.inlier_mask, 0.7)
    offset = found.points_in_world - points
    squared = np.einsum("ni,nij,nj->n", offset, np.linalg.inv(covariances), offset)
    for level in (0.9, 0.99):
        inside = (squared < chi2.ppf(level, 3)).mean()
        assert abs(inside - level) < 4 * np.sqrt(level * (1 - level) / 300) + 0.01


def test_covariance_of_two_view_points_covers_the_truth(rng):
    points = some_points(rng, 2000)
    found = triangulate_points(PAIR, CAMERA, seen_by(PAIR, [CAMERA, CAMERA], points, 0.5, rng))
    covariances = point_covariances(PAIR, CAMERA, found.points_in_world, found.inlier_mask, 0.5)
    offset = found.points_in_world - points
    squared = np.einsum("ni,nij,nj->n", offset, np.linalg.inv(covariances), offset)
    for level in (0.9, 0.99):
        assert abs((squared < chi2.ppf(level, 3)).mean() - level) < 0.02


def test_points_that_cannot_be_triangulated_say_why(rng):
    points = some_points(rng, 4)
    pixels = seen_by(PAIR, [CAMERA, CAMERA], points, 0.0, rng)
    pixels[0, 1] = np.nan
    pixels[1, 2] -= [0.0, 200.0]
    behind = triangulate_points(PAIR[::-1], CAMERA, pixels[:, [0]])
    assert behind.reason[0] == PointReason.BEHIND_CAMERA
    for cams, rows in ((PAIR, pixels), (Rigid3.exp(np.zeros((3, 6))), np.concatenate([pixels, pixels[:1]]))):
        found = triangulate_points(cams, CAMERA, rows, max_error_px=2.0, min_angle_rad=0.01)
        expected = {
            2: [PointReason.OK, PointReason.TOO_FEW_VIEWS, PointReason.LARGE_ERROR, PointReason.OK],
            3: [
                PointReason.SMALL_ANGLE,
                PointReason.TOO_FEW_VIEWS,
                PointReason.SMALL_ANGLE,
                PointReason.SMALL_ANGLE,
            ],
        }[len(cams)]
        if len(cams) == 2:
            assert list(found.reason) == expected
        else:
            assert not found.success_mask.any()
    same = triangulate_points(Rigid3.identity(2), CAMERA, np.stack([pixels[0], pixels[0]])[:, [0, 2, 3]])
    assert (same.reason == PointReason.SMALL_ANGLE).all() and np.isnan(same.points_in_world).all()


def test_wrong_arguments_are_refused():
    with pytest.raises(ShapeError):
        triangulate_points(PAIR, CAMERA, np.zeros((3, 5, 2)))
    with pytest.raises(ShapeError):
        triangulate_points(PAIR, [CAMERA], np.zeros((2, 5, 2)))
    with pytest.raises(ConfigError):
        triangulate_points(PAIR, CAMERA, np.zeros((2, 5, 2)), max_error_px=0.0)
    with pytest.raises(ConfigError):
        triangulate_points(PAIR, CAMERA, np.zeros((2, 5, 2)), min_angle_rad=-1.0)
    assert len(triangulate_points(PAIR, CAMERA, np.zeros((2, 0, 2))).reason) == 0


def test_threads_do_not_change_points(rng):
    pixels = seen_by(PAIR, [CAMERA, CAMERA], some_points(rng, 5000), 1.0, rng)
    _parallel.set_num_threads(2)
    many = triangulate_points(PAIR, CAMERA, pixels)
    _parallel.set_num_threads(1)
    one = triangulate_points(PAIR, CAMERA, pixels)
    _parallel.set_num_threads(None)
    np.testing.assert_array_equal(many.points_in_world, one.points_in_world)
