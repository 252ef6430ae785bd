"""Numbers, motions and tables of a parsed reconstruction.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from epipole.errors import ConfigError
from epipole.geometry import Rigid3, Rotation3

_MOST_ROTATION = 1e6
"""Radians; longer rotation vectors have lost their direction to rounding."""


def number_in(values: Mapping[str, Any], key: str, default: float | None = None) -> float:
    """A finite number.

    Raises:
        ConfigError: the key is missing and has no default, or its value is not a finite number.
    """
    value = values.get(key, default)
    if value is None:
        raise ConfigError(f"the key {key} is missing")
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ConfigError(f"{key} is not a number, got {str(value)[:40]!r}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ConfigError(f"{key} = {str(value)[:40]} is not a finite number")
    return number


def motion_of(values: Any, whose: str) -> Rigid3:
    """The motion of an object with `rotation` and `translation`.

    Raises:
        ConfigError: a value is not three finite numbers.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{whose} is not an object")
    rotation = _three_numbers(values.get("rotation"), f"the rotation of {whose}")
    translation = _three_numbers(values.get("translation", [0.0] * 3), f"the translation of {whose}")
    if not np.abs(rotation).max() < _MOST_ROTATION:
        raise ConfigError(f"the rotation vector of {whose} is too long")
    return Rigid3(Rotation3.exp(rotation).matrix, translation)


def _three_numbers(value: Any, what: str) -> np.ndarray:
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{what} is not three numbers") from error
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ConfigError(f"{what} is not three numbers")
    return array


def table_in(content: Mapping[str, Any], key: str) -> dict[str, Any]:
    """An object, empty if the key is missing.

    Raises:
        ConfigError: it is not an object.
    """
    found = content.get(key, {})
    if not isinstance(found, dict):
        raise ConfigError(f"{key} is not an object")
    return found
