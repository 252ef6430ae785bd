"""Corners stand out of the noise: of noise alone there are none, and the noise is told whatever stands before it."""

import numpy as np
import pytest
from slam_rides import ride

from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.tracking.corners import LEAST_NOISE, new_corners, noise_of
from epipole.synthetic import courtyard, render
from whole import IS_WHOLE

NONE = np.zeros((0, 2))
SIGMAS = [1.0, 1.25, 1.3, 1.7, 2.0, 3.0, 5.0, 7.0, 10.0] if IS_WHOLE else [1.0, 1.3, 3.0, 10.0]


def noisy(gray: np.ndarray, sigma: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, sigma, gray.shape)
    return np.rint(gray + noise).clip(0, 255).astype(np.uint8)


def slope(height: int, width: int) -> np.ndarray:
    row, column = np.mgrid[:height, :width]
    return 90.0 + 0.1 * column + 0.07 * row


@pytest.mark.parametrize("sigma", SIGMAS)
@pytest.mark.parametrize("size", [(240, 320), (480, 640)])
def test_noise_is_told(sigma, size):
    """On a flat wall, and on one with a shade."""
    for seed, wall in enumerate([np.full(size, 60.0), np.full(size, 128.4), slope(*size)]):
        assert noise_of(noisy(wall, sigma, seed)) == pytest.approx(sigma, rel=0.15)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
def test_texture_is_not_noise(sigma):
    """Strong corners over three fifths of the image, and a rendered courtyard."""
    wall = np.full((240, 320), 120.0)
    square = np.kron(np.random.default_rng(1).integers(0, 2, (40, 24)), np.ones((6, 8)))
    wall[:, :192] = 40 + 150 * square
    assert noise_of(noisy(wall, sigma, 2)) == pytest.approx(sigma, rel=0.3)
    seen = render(courtyard(), *_courtyard_view())
    clean = seen.rgb.astype(float).mean(axis=2)
    assert noise_of(noisy(clean, sigma, 3)) < 1.6 * sigma + 0.8


def _courtyard_view():
    from slam_rides import CAMERA, position

    return CAMERA, position(3, "arc")


@pytest.mark.parametrize("sigma", [0.0, 0.4, *SIGMAS, 25.0])
@pytest.mark.parametrize("level", [0.0, 3.0, 128.0, 252.0])
def test_noise_alone_has_no_corners(sigma, level):
    for seed in range(2):
        assert not len(new_corners(noisy(np.full((240, 320), level), sigma, seed), NONE, SlamConfig()))
    assert noise_of(np.full((240, 320), int(level), np.uint8)) == LEAST_NOISE


def test_a_dim_corner_is_taken_only_where_it_stands_out():
    wall = np.full((240, 320), 100.0)
    for row in range(40, 220, 40):
        for column in range(40, 300, 40):
            wall[row - 8 : row + 8, column - 8 : column + 8] += 12.0
    clear = new_corners(noisy(wall, 1.0, 0), NONE, SlamConfig())
    assert 80 <= len(clear) <= 140  # the 35 squares' corners, those that are far enough from each other
    off = np.abs((clear % 40) - np.where(clear % 40 < 20, 7.5, 31.5)).max()
    assert off < 3.0
    assert len(new_corners(noisy(wall, 8.0, 0), NONE, SlamConfig())) < 5


def test_as_many_as_are_wanted_and_away_from_those_that_are_there():
    gray, config = ride().left[0], SlamConfig()
    corners = new_corners(gray, NONE, config)
    assert 100 < len(corners) <= config.num_features
    more = new_corners(gray, corners[:60], config)
    assert len(more) <= config.num_features - 60
    apart = np.linalg.norm(more[:, None] - corners[None, :60], axis=2)
    assert apart.min() > config.min_distance_px - 1.0
    assert not len(new_corners(gray, np.zeros((config.num_features, 2)), config))
