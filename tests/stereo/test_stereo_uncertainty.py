"""Error bars of disparities on rooms they were not fitted on, and on real pairs."""

import numpy as np
import pytest

from epipole.disparity_search import uncertainty
from epipole.disparity_search.search import match_stereo
from epipole.errors import ConfigError
from epipole.pipelines.stereo.config import StereoConfig
from epipole.scene import StereoReason
from epipole.synthetic.stereo_rooms import stereo_room
from whole import IS_WHOLE


@pytest.fixture(scope="module")
def unseen():
    """Errors and sigmas of rendered rooms of odd number: the constants come from even ones."""
    errors, sigmas = [], []
    for seed in range(10_001, 10_017 if IS_WHOLE else 10_009, 2):
        pair = stereo_room(seed, (320, 240))
        found = match_stereo(
            pair.left, pair.right, StereoConfig(max_disparity_px=int(np.nanmax(pair.disparity_px)) + 8)
        )
        error = np.abs(found.disparity_px - pair.disparity_px)
        errors.append(error[np.isfinite(error)])
        sigmas.append(found.sigma_px[np.isfinite(error)])
        assert np.array_equal(np.isfinite(found.sigma_px), np.isfinite(found.disparity_px))
    return np.concatenate(errors), np.concatenate(sigmas)


def test_68_of_100_errors_lie_within_one_sigma(unseen):
    error, sigma = unseen
    assert 0.62 < (error <= sigma).mean() < 0.74
    for part in np.array_split(np.argsort(sigma, kind="stable"), 5):
        assert 0.55 < (error <= sigma)[part].mean() < 0.80


def test_the_most_certain_pixels_are_the_best(unseen):
    error, sigma = unseen
    mean = [error[part].mean() for part in np.array_split(np.argsort(sigma, kind="stable"), 5)]
    assert mean[0] < 0.5 * error.mean() and mean[4] > 2.0 * mean[2]


@pytest.mark.parametrize("options", [{"paths": 4}, {"left_right": "fast"}, {"window": (9, 7)}])
def test_other_ways_of_matching_keep_the_bars(options):
    """They were fitted with the defaults."""
    within = []
    for seed in range(10_001, 10_007, 2):
        pair = stereo_room(seed, (320, 240))
        config = StereoConfig(max_disparity_px=int(np.nanmax(pair.disparity_px)) + 8, **options)
        found = match_stereo(pair.left, pair.right, config)
        error = np.abs(found.disparity_px - pair.disparity_px)
        within.append((error <= found.sigma_px)[np.isfinite(error)])
    assert 0.60 < np.concatenate(within).mean() < 0.78


def test_sigma_grows_with_the_score():
    assert (np.diff(uncertainty.SCORES) > 0).all() and (np.diff(uncertainty.LOG_SIGMAS) >= 0).all()
    assert len(uncertainty.SCORES) == len(uncertainty.LOG_SIGMAS)
    assert uncertainty.score(np.zeros((uncertainty.NUM_CUES, 2, 3), np.float32)).shape == (2, 3)


def test_rooms_are_the_same_each_time():
    one, two = stereo_room(3, (64, 48)), stereo_room(3, (64, 48))
    np.testing.assert_array_equal(one.left, two.left)
    np.testing.assert_array_equal(one.right, two.right)
    assert one.left.shape == one.disparity_px.shape == (48, 64) and one.left.std() > 3
    assert not np.array_equal(stereo_room(4, (64, 48)).left, one.left)


def test_disparities_that_are_not_sure_enough_are_left_out():
    pair = stereo_room(5, (240, 180))
    every = match_stereo(pair.left, pair.right, StereoConfig(max_disparity_px=60))
    confirmed = match_stereo(pair.left, pair.right, StereoConfig(max_disparity_px=60, max_sigma_px=0.2))
    kept = every.sigma_px <= 0.2
    assert 0.2 < kept.mean() < 0.9
    np.testing.assert_array_equal(np.isfinite(confirmed.disparity_px), kept)
    np.testing.assert_array_equal(
        confirmed.reason == StereoReason.UNCERTAIN, np.isfinite(every.sigma_px) & ~kept
    )
    np.testing.assert_array_equal(confirmed.disparity_px[kept], every.disparity_px[kept])
    with pytest.raises(ConfigError, match="max_sigma_px"):
        StereoConfig(max_sigma_px=0.0)
