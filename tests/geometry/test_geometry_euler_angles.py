"""Euler angles: all orders, there and back, also where the second angle is a right angle, and against scipy."""

from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from epipole.errors import ConfigError
from epipole.geometry.euler_angles import euler_angles_of_rotation, rotation_of_euler_angles

ORDERS = ["".join(order) for order in permutations("xyz")]


@pytest.mark.parametrize("axes", ORDERS)
def test_the_product_is_that_of_scipy(axes: str) -> None:
    angles = np.random.default_rng(0).uniform(-3, 3, (50, 3))
    expected = Rotation.from_euler(axes.upper(), angles).as_matrix()  # upper case: intrinsic
    np.testing.assert_allclose(rotation_of_euler_angles(axes, angles).matrix, expected, atol=1e-14)


@pytest.mark.parametrize("axes", ORDERS)
def test_there_and_back_near_right_angles(axes: str) -> None:
    """For an offset of 1e-9 rad, angles that are computed independently of each other lose seven digits."""
    rng = np.random.default_rng(1)
    angles = rng.uniform(-np.pi, np.pi, (300, 3))
    angles[:200, 1] = np.repeat([1, -1], 100) * (np.pi / 2 - 10.0 ** rng.uniform(-16, -1, 200))
    rotation = rotation_of_euler_angles(axes, angles).matrix
    found = euler_angles_of_rotation(axes, rotation)
    assert (np.abs(found[:, 1]) <= np.pi / 2 + 1e-12).all()
    np.testing.assert_allclose(rotation_of_euler_angles(axes, found).matrix, rotation, atol=2e-15)


def test_other_axes_are_refused() -> None:
    for axes in ("xyx", "xy", "XYZ"):
        with pytest.raises(ConfigError, match="three different letters"):
            rotation_of_euler_angles(axes, np.zeros((1, 3)))
