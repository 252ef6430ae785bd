"""Numbers under a key of a file that was read into names and values."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import FileFormatError

_MOST_PIXELS = 1 << 20  # along a side


def numbers_of(path: Path, content: Mapping[str, Any], key: str, *shape: int) -> np.ndarray:
    """A matrix (a vector where no shape is given), however it is written: lists, a `data` list, or words in a line.

    Raises:
        FileFormatError: the key is missing, or holds something else.
    """
    if key not in content:
        raise FileFormatError(path, f"the key {key} is missing")
    value = content[key]
    if isinstance(value, Mapping):
        value = value.get("data", value)
    if isinstance(value, str):
        value = re.sub(r"[\[\];,]", " ", value).split()
    try:
        array = np.asarray(value, np.float64)
        array = array.reshape(shape) if shape else array.ravel()
    except (TypeError, ValueError) as error:
        what = f"{' x '.join(map(str, shape))} numbers" if shape else "a list of numbers"
        raise FileFormatError(path, f"{key} is not {what}") from error
    if not np.isfinite(array).all():
        raise FileFormatError(path, f"{key} has values that are not finite")
    return array


def size_of(path: Path, width: float, height: float) -> tuple[int, int]:
    """Width and height of pictures.

    Raises:
        FileFormatError: they are no sizes.
    """
    if not (1 <= width <= _MOST_PIXELS and 1 <= height <= _MOST_PIXELS):
        raise FileFormatError(path, f"pictures of {width:g} x {height:g} pixels cannot be")
    return int(width), int(height)
