"""Objects of known size: the true scale lies within what is stated, also where the cameras' places are uncertain."""

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.scale import fit_scale_to_object
from epipole.synthetic import look_at
from whole import IS_WHOLE

CAMERA = Camera("PINHOLE", 640, 480, [500.0, 500.0, 319.5, 239.5])
TAG = 0.06 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
BAR = np.array([[0.0, 0, 0], [1, 0, 0]])
SPREAD = np.diag([4e-6] * 3 + [1e-6] * 3)


def stacked(positions):
    return Rigid3(np.stack([p.rotation for p in positions]), np.stack([p.translation for p in positions]))


def seen(shape, rng, count=8, sigma=0.3, unit=1.0, reach=1.0):
    """Cameras (with errors, in a unit of their own) and pixels of an object."""
    centers = rng.normal(size=(count, 3)) * [reach, reach, 0.2] + [0, 0, -2.5]
    positions = [look_at(c, 0.1 * rng.normal(size=3), (0, -1, 0)) for c in centers]
    points = shape @ Rotation3.exp(0.4 * rng.normal(size=3)).matrix.T + 0.2 * rng.normal(size=3)
    pixels = np.stack([CAMERA.project(p.apply(points)) for p in positions])
    pixels += sigma * rng.standard_normal(pixels.shape)
    moved = stacked([Rigid3.exp(rng.multivariate_normal(np.zeros(6), SPREAD)) @ p for p in positions])
    shrunk = np.diag([1 / unit] * 3 + [1.0] * 3)
    covariance = np.tile(shrunk @ SPREAD @ shrunk, (count, 1, 1))
    return Rigid3(moved.rotation, moved.translation / unit), [CAMERA] * count, pixels, covariance


@pytest.mark.parametrize(("shape", "sigma"), [(TAG, 0.3)] + IS_WHOLE * [(BAR, 1.0)])
def test_the_true_scale_lies_within_what_is_stated(rng, shape, sigma):
    away = []
    for _ in range(60):
        cams, cameras, pixels, covariance = seen(shape, rng, sigma=sigma, unit=2.5)
        fit = fit_scale_to_object(shape, cams, cameras, pixels, sigma, covariance)
        away.append((fit.scale - 2.5) / fit.sigma)
    away = np.array(away)
    assert 0.7 < away.std() < 1.25 and (np.abs(away) < 2).mean() >= 0.9


def test_uncertain_cameras_are_part_of_the_deviation(rng):
    cams, cameras, pixels, covariance = seen(TAG, rng)
    found = [
        fit_scale_to_object(TAG, cams, cameras, pixels, 0.3, fraction * covariance)
        for fraction in (1.0, 100.0)
    ]
    assert found[1].sigma > 2.0 * found[0].sigma
    assert "8 of 8 views" in repr(found[0])


def test_a_view_whose_pixels_do_not_fit_is_left_out(rng):
    cams, cameras, pixels, covariance = seen(TAG, rng, unit=2.0)
    pixels[3] += 60.0
    fit = fit_scale_to_object(TAG, cams, cameras, pixels, 0.3, covariance)
    assert np.flatnonzero(~fit.kept_mask).tolist() == [3]
    assert fit.scale == pytest.approx(2.0, abs=4 * fit.sigma)


def test_ends_may_be_seen_in_different_pictures(rng):
    cams, cameras, pixels, covariance = seen(BAR, rng, sigma=0.0)
    pixels[:4, 0], pixels[4:, 1] = np.nan, np.nan
    fit = fit_scale_to_object(BAR, cams, cameras, pixels, 1.0, covariance)
    assert fit.scale == pytest.approx(1.0, abs=4 * fit.sigma)


def test_too_little_is_refused(rng):
    cams, cameras, pixels, _ = seen(BAR, rng)
    with pytest.raises(DegenerateGeometryError, match="seen in 1 posed image"):
        fit_scale_to_object(BAR, cams[:1], cameras[:1], pixels[:1], 1.0)
    with pytest.raises(DegenerateGeometryError, match="no posed image"):
        fit_scale_to_object(BAR, cams, cameras, np.full_like(pixels, np.nan), 1.0)
    one_place = seen(BAR, rng, reach=0.0, sigma=0.1)
    still = stacked([one_place[0][0]] * 8)
    same = np.repeat(one_place[2][:1], 8, axis=0)
    with pytest.raises(DegenerateGeometryError, match="too little parallax"):
        fit_scale_to_object(BAR, still, cameras, same, 1.0)
    mixed = pixels[rng.permutation(8)] + 80.0 * rng.standard_normal(pixels.shape)
    with pytest.raises(DegenerateGeometryError):
        fit_scale_to_object(BAR, cams, cameras, mixed, 0.3)


def test_misuse(rng):
    cams, cameras, pixels, _ = seen(TAG, rng)
    with pytest.raises(ConfigError, match="sigma_px"):
        fit_scale_to_object(TAG, cams, cameras, pixels, 0.0)
    with pytest.raises(ShapeError, match="pixels must have 8 rows"):
        fit_scale_to_object(TAG, cams[:3], cameras, pixels, 1.0)
    with pytest.raises(ShapeError, match="at least two rows"):
        fit_scale_to_object(TAG[:1], cams, cameras, pixels[:, :1], 1.0)
