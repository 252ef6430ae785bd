"""Robust estimators against known answers, with outliers, and their failures."""

import numpy as np
import pytest

from epipole import _parallel
from epipole.cameras import Camera, CameraModel
from epipole.config import RansacConfig
from epipole.errors import ConfigError
from epipole.geometry import Rigid3, Rotation3, from_homogeneous, sampson_error, to_homogeneous
from epipole.robust import (
    PairKind,
    PairMatches,
    Reason,
    estimate_absolute_pose,
    estimate_essential_matrix,
    estimate_fundamental_matrix,
    estimate_homography,
    estimate_relative_pose,
    verify_pair,
    verify_pairs,
)

CAMERA = Camera(CameraModel.SIMPLE_RADIAL, 1000, 800, np.array([900.0, 499.5, 399.5, -0.05]))


def two_views(rng, count=600, outliers=0.4, noise_px=0.7, motion=None, plane=False):
    if motion is None:
        motion = Rigid3.exp(np.array([-1.0, 0.1, 0.2, 0.05, 0.15, -0.02]))
    points = rng.uniform([-2, -1.6, 4], [2, 1.6, 8], (count, 3))
    if plane:
        points[:, 2] = 5 + 0.3 * points[:, 0]
    x1, x2 = CAMERA.project(points), CAMERA.project(motion.apply(points))
    x1, x2 = x1 + noise_px * rng.normal(size=x1.shape), x2 + noise_px * rng.normal(size=x2.shape)
    wrong = np.arange(count) < outliers * count
    x2[wrong] = rng.uniform(0, [999, 799], (wrong.sum(), 2))
    return x1, x2, ~wrong, motion, points


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
def test_essential_matrix_finds_motion_and_inliers(rng, outliers):
    x1, x2, truth, motion, _ = two_views(rng, outliers=outliers)
    found = estimate_relative_pose(x1, x2, CAMERA, CAMERA, RansacConfig(max_error_px=3))
    assert found.success
    assert (found.inlier_mask & truth).sum() > 0.97 * truth.sum()
    rotation = Rotation3(found.model.rotation @ motion.rotation.T).angle_rad()
    direction = motion.translation / np.linalg.norm(motion.translation)
    assert np.rad2deg(rotation) < 0.2
    assert np.rad2deg(np.arccos(np.clip(direction @ found.model.translation, -1, 1))) < 1.0


def test_fundamental_matrix_explains_the_inliers(rng):
    pinhole = Camera(CameraModel.PINHOLE, 1000, 800, np.array([900.0, 900.0, 499.5, 399.5]))
    motion, points = (
        Rigid3.exp(np.array([-1.0, 0.1, 0.2, 0.05, 0.15, -0.02])),
        rng.uniform([-2, -1.6, 4], [2, 1.6, 8], (500, 3)),
    )
    exact1, exact2 = pinhole.project(points), pinhole.project(motion.apply(points))
    x1, x2 = exact1 + 0.5 * rng.normal(size=(500, 2)), exact2 + 0.5 * rng.normal(size=(500, 2))
    x2[:200] = rng.uniform(0, 800, (200, 2))
    found = estimate_fundamental_matrix(x1, x2, RansacConfig(max_error_px=2))
    assert found.success
    assert np.linalg.matrix_rank(found.model, tol=1e-9) == 2
    assert np.median(sampson_error(found.model, exact1[200:], exact2[200:])) < 0.15


def test_homography_is_near_the_truth(rng):
    H = np.array([[1.05, 0.02, 12.0], [-0.03, 0.98, -7.0], [2e-5, -1e-5, 1.0]])
    exact1 = rng.uniform(0, 800, (400, 2))
    exact2 = from_homogeneous(to_homogeneous(exact1) @ H.T)
    x2 = exact2 + 0.5 * rng.normal(size=(400, 2))
    x2[:200] = rng.uniform(0, 800, (200, 2))
    found = estimate_homography(exact1, x2)
    assert found.success
    error = np.linalg.norm(from_homogeneous(to_homogeneous(exact1) @ found.model.T) - exact2, axis=1)
    assert error.mean() < 0.2


@pytest.mark.parametrize("model", list(CameraModel))
def test_absolute_pose_for_every_camera_model(rng, model):
    params = {
        0: [800, 499, 399],
        1: [800, 810, 499, 399],
        2: [800, 499, 399, -0.1],
        3: [800, 499, 399, -0.1, 0.02],
    }
    params |= {
        4: [800, 810, 499, 399, -0.1, 0.02, 1e-3, -1e-3],
        5: [500, 505, 499, 399, 0.02, -0.01, 0.002, -0.001],
        6: [800, 810, 499, 399, -0.1, 0.02, 1e-3, -1e-3, 0.01, 0.05, 0.01, 0.0],
    }
    camera = Camera(model, 1000, 800, np.array(params[int(model)], float))
    motion = Rigid3.exp(np.array([0.5, -0.2, 0.3, 0.2, -0.3, 0.1]))
    points = motion.inverse().apply(rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (300, 3)))
    pixels = camera.project(motion.apply(points)) + 0.5 * rng.normal(size=(300, 2))
    pixels[:150] = rng.uniform(0, 800, (150, 2))
    found = estimate_absolute_pose(points, pixels, camera)
    assert found.success
    assert np.abs((found.model @ motion.inverse()).log()).max() < 5e-3


def test_failures_are_data(rng):
    few = rng.uniform(0, 500, (4, 2))
    assert estimate_essential_matrix(few, few, CAMERA, CAMERA).reason is Reason.TOO_FEW
    noise1, noise2 = rng.uniform(0, 800, (80, 2)), rng.uniform(0, 800, (80, 2))
    result = estimate_essential_matrix(noise1, noise2, CAMERA, CAMERA, RansacConfig(max_error_px=0.5))
    assert result.reason is Reason.TOO_FEW_INLIERS and not result.success
    empty = estimate_absolute_pose(np.zeros((0, 3)), np.zeros((0, 2)), CAMERA)
    assert empty.reason is Reason.TOO_FEW and empty.num_inliers == 0
    with pytest.raises(ConfigError):
        RansacConfig(max_error_px=-1)


def test_nan_matches_are_outliers(rng):
    x1, x2, _, _, _ = two_views(rng, outliers=0.2)
    x1[5], x2[7] = np.nan, np.inf
    found = estimate_essential_matrix(x1, x2, CAMERA, CAMERA)
    assert found.success and not found.inlier_mask[[5, 7]].any()


def test_same_seed_same_answer_and_inputs_untouched(rng):
    x1, x2, _, _, _ = two_views(rng)
    before = x1.copy(), x2.copy()
    first, second, other = (
        estimate_essential_matrix(x1, x2, CAMERA, CAMERA, RansacConfig(seed=seed)) for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first.model, second.model)
    np.testing.assert_array_equal(first.inlier_mask, second.inlier_mask)
    assert (first.model != other.model).any()  # the seed has a say
    np.testing.assert_array_equal(x1, before[0])
    np.testing.assert_array_equal(x2, before[1])


def test_pairs_verified_on_any_number_of_threads_are_the_same(rng):
    """Twenty pairs in chunks: on one thread in a row, on more at once."""
    pairs = []
    for seed in range(20):
        x1, x2, *_ = two_views(rng, count=200 + 10 * seed, plane=seed % 3 == 0)
        pairs.append(PairMatches(x1, x2, CAMERA, CAMERA, seed=seed))
    results = []
    try:
        for threads in (1, 2, 5):
            _parallel.set_num_threads(threads)
            results.append(verify_pairs(pairs))
    finally:
        _parallel.set_num_threads(None)
    assert {g.kind for g in results[0]} == {PairKind.GENERAL, PairKind.PLANAR}
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert a.kind is b.kind and a.noise_px == b.noise_px
            np.testing.assert_array_equal(a.inlier_mask, b.inlier_mask)
            np.testing.assert_array_equal(a.fundamental, b.fundamental)
            np.testing.assert_array_equal(a.costs, b.costs)


@pytest.mark.parametrize("is_calibrated", [True, False])
def test_kinds_of_pairs(rng, is_calibrated):
    def kind(**options):
        x1, x2, _, _, _ = two_views(rng, outliers=0.2, **options)
        return verify_pair(x1, x2, CAMERA, CAMERA, is_calibrated=is_calibrated, config=RansacConfig())

    general = kind()
    assert general.kind is (PairKind.GENERAL if is_calibrated else PairKind.UNCALIBRATED)
    assert 5 < np.rad2deg(general.median_angle_rad) < 20
    rotated = Rigid3.exp(np.array([0, 0, 0, 0.05, 0.2, 0.03]))
    rotation = kind(motion=rotated)
    assert rotation.kind is PairKind.ROTATION and np.isnan(rotation.median_angle_rad)
    assert (
        np.abs(
            (Rotation3(rotation.cam2_from_cam1.rotation) @ Rotation3(rotated.rotation).inverse()).log()
        ).max()
        < 5e-3
    )
    assert kind(motion=Rigid3.identity(), noise_px=0.1).kind is PairKind.NO_MOTION
    if is_calibrated:
        assert kind(plane=True).kind is PairKind.PLANAR


def test_unrelated_pictures_are_degenerate(rng):
    noise1, noise2 = rng.uniform(0, 800, (60, 2)), rng.uniform(0, 800, (60, 2))
    pair = verify_pair(
        noise1, noise2, CAMERA, CAMERA, is_calibrated=True, config=RansacConfig(max_error_px=1)
    )
    assert pair.kind is PairKind.DEGENERATE and not pair.inlier_mask.any()
