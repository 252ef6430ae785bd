"""Rotations as products of rotations about three different coordinate axes (Euler angles of the Tait-Bryan kind).

For the axes (i, j, k), the rotation is R_i(a) R_j(b) R_k(c), with matrices that multiply columns. Let s be 1 if i, j, k is
x, y, z or a cyclic permutation of it, else -1. Then R[j, k] = -s sin(a) cos(b) and R[k, k] = cos(a) cos(b). The product
R_j(b) R_k(c) = R_i(-a) R gives b and c, which is also accurate where cos(b) is zero and `a` is arbitrary.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.errors import ConfigError
from epipole.geometry.rotation3 import Rotation3

_AXES = "xyz"
_CYCLIC = ("xyz", "yzx", "zxy")


@checked
def rotation_of_euler_angles(axes: str, angles_rad: Float64[np.ndarray, "n 3"]) -> Rotation3:
    """The rotations R_i(a) R_j(b) R_k(c).

    Args:
        axes: three different letters of x, y and z, in the order of the product.
        angles_rad: (n, 3) a, b and c in radians.

    Raises:
        ConfigError: the axes are not three different letters of x, y and z.
    """
    first, second, third = (
        Rotation3.exp(angles_rad[:, n, None] * np.eye(3)[axis]) for n, axis in enumerate(_rows(axes))
    )
    return first @ second @ third


@checked
def euler_angles_of_rotation(axes: str, rotation: Float64[np.ndarray, "n 3 3"]) -> Float64[np.ndarray, "n 3"]:
    """The angles a, b and c of rotations R_i(a) R_j(b) R_k(c); a and c from -pi to pi, b from -pi / 2 to pi / 2.

    Args:
        axes: three different letters of x, y and z, in the order of the product.
        rotation: (n, 3, 3) rotation matrices.

    Raises:
        ConfigError: the axes are not three different letters of x, y and z.
    """
    i, j, k = _rows(axes)
    sign = 1.0 if axes in _CYCLIC else -1.0
    first = np.arctan2(-sign * rotation[:, j, k], rotation[:, k, k])
    rest = Rotation3.exp(-first[:, None] * np.eye(3)[i]).matrix @ rotation
    second = np.arctan2(sign * rest[:, i, k], rest[:, k, k])
    third = np.arctan2(sign * rest[:, j, i], rest[:, j, j])
    return np.stack([first, second, third], axis=1)


def _rows(axes: str) -> list[int]:
    if sorted(axes) != list(_AXES):
        raise ConfigError(f"axes must be three different letters of x, y and z, got {axes!r}")
    return [_AXES.index(axis) for axis in axes]
