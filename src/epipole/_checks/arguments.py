"""Checks at the public API (shapes, finiteness, memory layout), with messages that name the argument."""

import errno
import os
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks.values import refuse_address
from epipole.errors import ConfigError, ShapeError

MOST_PIXELS = 1 << 28
"""Limit of new images, which take about 16 bytes per pixel."""
MOST_RENDERED_PIXELS = 1 << 27
"""Limit of rendered images, which take twice as much."""
_NO_PATH = (errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL)


def as_float_array(array: Any, name: str, *tail: int, finite: bool = False) -> np.ndarray:
    """Return `array` as a C-contiguous float64 array whose last axes are `tail` (batch axes are free).

    Read-only arrays are copied, as kernels are compiled for writeable arrays only.

    Raises:
        ShapeError: the trailing axes differ, the values are not numbers, or `finite` is set and some are not.
    """
    try:
        given = np.asarray(array)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ShapeError(f"{name} must be an array of numbers: {error}") from error
    if given.dtype.kind not in "biuf":  # text, objects and complex numbers
        raise ShapeError(f"{name} must be an array of numbers, got {given.dtype}")
    out = np.ascontiguousarray(given, dtype=np.float64)
    if not out.flags.carray:
        out = out.copy()
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
        ShapeError: it is not (n, dim), or `finite` is set and a value is not.
    """
    out = as_float_array(array, name, finite=finite)
    if out.ndim != 2 or out.shape[1] != dim:
        hint = "; transpose?" if out.ndim == 2 and out.shape[0] == dim else ""
        if out.ndim == 3 and out.shape[2] == dim and 1 in out.shape[:2]:
            hint = f"; OpenCV's points? .reshape(-1, {dim})"
        raise ShapeError(f"{name} must be (n, {dim}), got {out.shape}{hint}")
    return out


def as_table(array: Any, name: str, rows: int, columns: int) -> np.ndarray:
    """Return `array` as a C-contiguous (rows, columns) float64 array of finite numbers.

    Raises:
        ShapeError: it has other axes, or a value is not finite.
    """
    out = as_float_array(array, name, rows, columns, finite=True)
    if out.ndim != 2:
        raise ShapeError(f"{name} must be ({rows}, {columns}), got {out.shape}")
    return out


def as_image(image: Any, name: str) -> np.ndarray:
    """Return an image as a C-contiguous array of unchanged type.

    Raises:
        ShapeError: it is not an array.
    """
    try:
        return np.ascontiguousarray(image)
    except (TypeError, ValueError, OverflowError) as error:
        raise ShapeError(f"{name} must be an image: {error}") from error


def as_vector(vector: Any, name: str) -> np.ndarray:
    """Return a single vector (3,) of finite numbers.

    Raises:
        ShapeError: it is not a single vector, or not finite.
    """
    out = as_float_array(vector, name, 3, finite=True)
    if out.ndim != 1:
        raise ShapeError(f"{name} must be (3,), got {out.shape}")
    return out


def as_directions(rays: np.ndarray, name: str) -> np.ndarray:
    """Rays (n, 3) scaled to unit length.

    Raises:
        ShapeError: a ray is zero, or not finite.
    """
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    if not ((length > 0) & (length < np.inf)).all():
        raise ShapeError(f"{name} must be finite, nonzero directions")
    return rays / length


def require_same_length(**arrays: np.ndarray) -> int:
    """Return the common first-axis length of the named arrays.

    Raises:
        ShapeError: they differ.
    """
    lengths = {name: len(a) for name, a in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise ShapeError("array lengths differ: " + ", ".join(f"{k} has {v}" for k, v in lengths.items()))
    return next(iter(lengths.values()))


def check_broadcast(**shapes: tuple[int, ...]) -> None:
    """Check that the named shapes can be broadcast.

    Raises:
        ShapeError: they cannot be broadcast.
    """
    if len(set(shapes.values())) > 1:
        try:
            np.broadcast_shapes(*shapes.values())
        except ValueError as error:
            raise ShapeError(
                "shapes cannot be broadcast: " + ", ".join(f"{k} {v}" for k, v in shapes.items())
            ) from error


def check_indices(index: np.ndarray, name: str, size: int) -> None:
    """Check that every index is in range(size).

    Raises:
        ShapeError: an index is out of range.
    """
    if index.size and not (index.min() >= 0 and index.max() < size):
        raise ShapeError(f"{name} must be from 0 to {size - 1}, got {index.min()} to {index.max()}")


def check_different(index: np.ndarray, name: str, size: int) -> None:
    """Check that all indices are in range(size) and distinct.

    Raises:
        ShapeError: an index is out of range, or repeated.
    """
    check_indices(index, name, size)
    if len(index) and np.bincount(index).max() > 1:
        raise ShapeError(f"{name} must be distinct, got {np.bincount(index).argmax()} twice")


def check_index(index: int, name: str, size: int) -> None:
    """Check that an index is in range(size); negative ones are not.

    Raises:
        ConfigError: the index is out of range.
    """
    if not 0 <= index < size:
        raise ConfigError(f"{name} must be from 0 to {size - 1}, got {index}")


def check_count(count: int, name: str, most: int = 1 << 24) -> None:
    """Check a count for which arrays will be allocated.

    Raises:
        ConfigError: it is negative, or more than `most`.
    """
    if count < 0:
        raise ConfigError(f"{name} must not be negative, got {count}")
    if count > most:
        raise ConfigError(f"{name} must be at most {most}, got {count}")


def check_pixels(width: int, height: int, most: int = MOST_PIXELS) -> None:
    """Check the size of a new image, as cameras from files may have any size.

    Raises:
        ConfigError: it has no pixels, or too many.
    """
    if min(width, height) < 1 or width * height > most:
        raise ConfigError(f"an image must have between 1 and {most} pixels, got {width} x {height}")


def check_squarable(value: float, name: str) -> None:
    """Check that the square of a number does not overflow; infinity is accepted.

    Raises:
        ConfigError: it is too large.
    """
    if 1e150 < abs(value) < np.inf:
        raise ConfigError(f"{name} is too large: {value:g}")


def check_fraction(fraction: float, name: str) -> None:
    """Check a fraction.

    Raises:
        ConfigError: it is not from 0 to 1.
    """
    if not 0.0 <= fraction <= 1.0:
        raise ConfigError(f"{name} must be from 0 to 1, got {fraction:g}")


def check_seed(seed: int) -> None:
    """Check a random seed.

    Raises:
        ConfigError: it is negative.
    """
    if seed < 0:
        raise ConfigError(f"seed must not be negative, got {seed}")


def check_offsets(offsets: np.ndarray, name: str, total: int | None = None) -> None:
    """Check that offsets of compressed rows increase from zero (to the total number of rows).

    Raises:
        ShapeError: they do not.
    """
    if not len(offsets) or offsets[0] != 0 or (offsets[1:] < offsets[:-1]).any():
        raise ShapeError(f"{name} must increase from 0")
    if total is not None and offsets[-1] != total:
        raise ShapeError(f"{name} must end at {total}, got {offsets[-1]}")


def as_path(given: str | Path) -> Path:
    """The given path, with a leading ~ expanded; an empty string, which would mean the current folder, is rejected.

    Raises:
        ConfigError: it is empty, invalid, or a URL.
    """
    if not isinstance(given, str | PathLike) or not isinstance(os.fspath(given), str):
        raise ConfigError(f"a path must be text or a Path, got {given!r:.60}")
    if "\0" in str(given):
        raise ConfigError("a path contains a null character")
    if str(given) == "":
        raise ConfigError("a path is empty")
    refuse_address(given, "the path")
    path = Path(os.path.expanduser(given))  # noqa: PTH111 - Path.expanduser fails for unknown users
    try:
        path.stat()
    except (OSError, ValueError) as error:
        code = getattr(error, "errno", errno.EINVAL)
        if code in _NO_PATH:
            raise ConfigError(f"{str(given)[:100]!r} cannot be a path: {os.strerror(code)}") from error
    return path
