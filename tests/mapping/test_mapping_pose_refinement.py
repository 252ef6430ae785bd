"""One camera before known points: the least robust error, its covariance, and its kernel against plain Python."""

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.mapping import Disparities, _pose_kernels, pose_refinement, refine_pose
from kernel_references import assert_same_as_python, record_calls, reference_of

CAMERA = Camera("OPENCV", 640, 480, [520.0, 525.0, 319.5, 239.5, -0.1, 0.02, 1e-3, -1e-3])
FOCAL_BASELINE = 40.0


def seen(rng, n=200, noise_px=0.0, num_wrong=0):
    """Points before a camera, where it sees them, its place, and their disparities."""
    in_cam = np.stack([rng.uniform(-1.5, 1.5, n), rng.uniform(-1, 1, n), rng.uniform(2, 6, n)], axis=1)
    position = Rigid3.exp(rng.normal(size=6))
    pixels = CAMERA.project(in_cam) + noise_px * rng.normal(size=(n, 2))
    pixels[:num_wrong] += 40.0 * rng.normal(size=(num_wrong, 2))
    disparity = FOCAL_BASELINE / in_cam[:, 2] + noise_px * rng.normal(size=n)
    return position.inverse().apply(in_cam), pixels, position, disparity


def off(found, position):
    return np.abs((found.cam_from_world @ position.inverse()).log()).max()


@pytest.mark.parametrize("with_depth", [False, True])
def test_without_noise_the_place_is_found_exactly(rng, with_depth):
    points, pixels, position, disparity = seen(rng)
    depth = Disparities(disparity, FOCAL_BASELINE) if with_depth else None
    found = refine_pose(
        points, pixels, CAMERA, Rigid3.exp(0.05 * rng.normal(size=6)) @ position, disparities=depth
    )
    assert off(found, position) < 1e-10 and found.error_sq.max() < 1e-12


def test_a_third_of_wrong_matches_does_not_matter(rng):
    points, pixels, position, _ = seen(rng, noise_px=0.3, num_wrong=66)
    found = refine_pose(points, pixels, CAMERA, Rigid3.exp(0.02 * rng.normal(size=6)) @ position)
    assert off(found, position) < 5e-3
    assert (found.error_sq[:66] > 9).mean() > 0.9 and (found.error_sq[66:] < 9).all()


def test_the_covariance_is_that_of_many_draws(rng):
    """Normalized errors squared have the mean of chi square with six degrees of freedom."""
    total, samples = 0.0, 150
    for _ in range(samples):
        points, pixels, position, disparity = seen(rng, n=60, noise_px=0.5)
        sigma, depth = np.full(60, 0.5), Disparities(disparity, FOCAL_BASELINE, 0.5)
        found = refine_pose(points, pixels, CAMERA, position, sigma, depth, loss_scale=50.0)
        xi = (position @ found.cam_from_world.inverse()).log()
        total += xi @ found.information @ xi
    assert 5.1 < total / samples < 6.9  # two standard deviations of the mean of 150


@pytest.mark.parametrize("with_depth", [False, True])
def test_the_covariance_by_errors_needs_no_deviations(rng, with_depth):
    """Half of the points, those far from the middle, are ten times worse, and nobody said so."""
    by_errors, by_noise, samples = 0.0, 0.0, 150
    for _ in range(samples):
        points, pixels, position, disparity = seen(rng)
        far = np.linalg.norm(pixels - [320, 240], axis=1)
        noise = np.where(far > np.median(far), 0.5, 0.05)
        pixels += noise[:, None] * rng.normal(size=pixels.shape)
        disparity += noise * rng.normal(size=len(disparity))
        depth = Disparities(disparity, FOCAL_BASELINE) if with_depth else None
        found = refine_pose(points, pixels, CAMERA, position, disparities=depth, loss_scale=50.0)
        xi = (position @ found.cam_from_world.inverse()).log()
        by_errors += xi @ np.linalg.solve(found.covariance_by_errors(), xi) / samples
        by_noise += xi @ np.linalg.solve(np.mean(noise**2) * found.covariance(), xi) / samples
    assert 5.1 < by_errors < 6.9
    assert by_noise > 7.5


def test_depth_narrows_the_place(rng):
    points, pixels, position, disparity = seen(rng, n=8)
    plain = refine_pose(points, pixels, CAMERA, position).covariance()
    deep = refine_pose(
        points, pixels, CAMERA, position, disparities=Disparities(disparity, FOCAL_BASELINE)
    ).covariance()
    assert (np.diag(deep) < np.diag(plain)).all()


def test_too_little_is_no_covariance(rng):
    points, pixels, position, _ = seen(rng)
    assert np.isinf(refine_pose(points[:2], pixels[:2], CAMERA, position).covariance()).all()
    for found in (refine_pose(points[:k], pixels[:k], CAMERA, position) for k in (0, 3)):
        assert np.isinf(found.covariance_by_errors()).all()
    assert np.isinf(refine_pose(points[:0], pixels[:0], CAMERA, position).covariance()).all()
    behind = refine_pose(-points, pixels, CAMERA, Rigid3.identity())
    assert np.isfinite(behind.cam_from_world.rotation).all()


def test_what_does_not_fit_is_refused(rng):
    points, pixels, position, _ = seen(rng)
    with pytest.raises(ConfigError, match="sigma_px must be positive"):
        refine_pose(points, pixels, CAMERA, position, np.zeros(200))
    with pytest.raises(ConfigError, match="loss_scale"):
        refine_pose(points, pixels, CAMERA, position, loss_scale=0.0)
    with pytest.raises(ShapeError, match="single motion"):
        refine_pose(points, pixels, CAMERA, Rigid3.identity(2))
    with pytest.raises(ShapeError, match="disparities"):
        refine_pose(points, pixels, CAMERA, position, disparities=Disparities(np.ones(3), 1.0))


@reference_of(_pose_kernels.refine_pose)
@pytest.mark.parametrize("num_wrong", [0, 5])
def test_the_kernel_is_its_source(rng, monkeypatch, num_wrong):
    points, pixels, position, disparity = seen(rng, n=12, noise_px=0.5, num_wrong=num_wrong)
    calls = record_calls(monkeypatch, pose_refinement, _pose_kernels.refine_pose)
    start = Rigid3.exp(0.02 * rng.normal(size=6)) @ position
    disparity[::3] = np.nan
    refine_pose(points, pixels, CAMERA, start, disparities=Disparities(disparity, FOCAL_BASELINE))
    (arguments,) = calls
    assert_same_as_python(_pose_kernels.refine_pose, *arguments, rtol=1e-6, atol=1e-9)
