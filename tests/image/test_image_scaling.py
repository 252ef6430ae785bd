"""Smaller images, and numbers as colors."""

import numpy as np
import pytest

from epipole.image import color_map, color_range, downscaled


def test_downscaled_keeps_shape_and_mean() -> None:
    image = np.zeros((400, 600, 3), np.uint8)
    image[:, 300:] = 200
    small = downscaled(image, 60)
    assert small.shape == (40, 60, 3)
    assert small.mean() == pytest.approx(100, abs=1)
    assert downscaled(small, 60) is small
    assert downscaled(np.zeros((1, 900, 3), np.uint8), 90).shape == (1, 90, 3)
    assert downscaled(np.zeros((80, 40), np.uint8), 20).shape == (20, 10)


def test_colors_run_from_blue_to_red_over_the_percentiles() -> None:
    values = np.linspace(-3.0, 5.0, 1001).reshape(7, 143)
    assert color_range(values) == pytest.approx((-2.92, 4.92))
    rgb = color_map(values)
    assert rgb.shape == (7, 143, 3)
    assert rgb[0, 50, 2] > rgb[0, 50, 0] and rgb[6, 90, 0] > rgb[6, 90, 2]
    # Beyond the percentiles a color stays that of the end, and one row is colored as many are.
    assert (rgb[0, :10] == rgb[0, 0]).all() and (rgb[6, -10:] == rgb[6, -1]).all()
    np.testing.assert_array_equal(color_map(values.ravel()), rgb.reshape(-1, 3))


@pytest.mark.parametrize("values", [np.full((3, 3), np.nan), np.array([np.inf, -np.inf])])
def test_what_is_not_known_is_black(values: np.ndarray) -> None:
    assert color_range(values) == (0.0, 1.0)
    assert (color_map(values) == 0).all()
    mixed = color_map(np.concatenate([values.ravel(), [1.0, 2.0]]))
    assert (mixed[:-2] == 0).all() and mixed[-2:].any(axis=1).all()


def test_no_value_and_one_value() -> None:
    assert color_map(np.zeros(0)).shape == (0, 3)
    assert color_map(np.array([7.0])).shape == (1, 3)
