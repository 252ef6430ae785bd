"""Checks at the public border: shapes, finiteness, kernels' memory layout, with messages that name the argument."""

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import ConfigError, ShapeError

_NO_PATH = (errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL)


def as_float_array(array: Any, name: str, *tail: int, finite: bool = False) -> np.ndarray:
    """Return `array` as a C-contiguous float64 array whose last axes are `tail` (batch axes are free).

    Raises:
        ShapeError: the trailing axes differ, the values are not numbers, or `finite` and some are not.
    """
    try:
        given = np.asarray(array)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"{name} must be an array of numbers: {error}") from error
    if given.dtype.kind not in "biuf":  # text, objects and complex numbers
        raise ShapeError(f"{name} must be an array of numbers, got {given.dtype}")
    out = np.ascontiguousarray(given, dtype=np.float64)
    if tail and out.shape[-len(tail) :] != tail:
        shape = "(..., " + ", ".join(map(str, tail)) + ")"
        hint = "; transpose?" if out.ndim >= 2 and out.shape[-2:] == (*tail, out.shape[-1]) else ""
        raise ShapeError(f"{name} must have shape {shape}, got {out.shape}{hint}")
    if finite and not np.isfinite(out).all():
        raise ShapeError(f"{name} must be finite; {int((~np.isfinite(out)).sum())} values are not")
    return out


def as_points(array: Any, name: str, dim: int, *, finite: bool = False) -> np.ndarray:
    """Return `array` as a C-contiguous (n, dim) float64 array.

    Raises:
        ShapeError: it is not (n, dim), or `finite` and some value is not.
    """
    out = as_float_array(array, name, finite=finite)
    if out.ndim != 2 or out.shape[1] != dim:
        hint = "; transpose?" if out.ndim == 2 and out.shape[0] == dim else ""
        raise ShapeError(f"{name} must be (n, {dim}), got {out.shape}{hint}")
    return out


def require_same_length(**arrays: np.ndarray) -> int:
    """Return the common first-axis length of the named arrays.

    Raises:
        ShapeError: they differ.
    """
    lengths = {name: len(a) for name, a in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise ShapeError("lengths differ: " + ", ".join(f"{k} has {v}" for k, v in lengths.items()))
    return next(iter(lengths.values()))


def as_path(given: str | Path) -> Path:
    """The path given, a leading ~ read as the home folder; an empty string, which would mean the current one, is refused.

    Raises:
        ConfigError: it is empty, or cannot be a path.
    """
    if str(given) == "":
        raise ConfigError("a path is empty")
    path = Path(os.path.expanduser(given))  # noqa: PTH111 - Path.expanduser fails for users that it does not know
    try:
        path.stat()
    except (OSError, ValueError) as error:
        code = getattr(error, "errno", errno.EINVAL)
        if code in _NO_PATH:
            raise ConfigError(f"{str(given)[:100]!r} cannot be a path: {os.strerror(code)}") from error
    return path
