"""Validation of arrays from untrusted files, against a table that describes each array.

Whoever writes a file can also compute its digest: a digest detects accidental damage, not inconsistent arrays. So every array has
an entry in the table of its file: its type, its shape with named axes, and its bounds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from epipole._checks.arrays import as_array, check_axes
from epipole._checks.kinds import Sizes
from epipole.errors import ShapeError

TEXT = "str"
_ROTATION_TOLERANCE = 1e-6
_LAST_CODE, _SURROGATES = 0x10FFFF, (0xD800, 0xDFFF)
"""The last code point of Unicode, and the surrogates, which are not characters."""


@dataclass(frozen=True, slots=True)
class Expected:
    """Description of an array in a file."""

    numbers: str
    """Name of a NumPy type, or `TEXT`; integers of another width are converted if they fit."""
    axes: str = ""
    """Lengths, names shared by arrays of the file, one more than such a name (n+1), or _ for any; empty for a scalar."""
    least: float | None = None
    most: float | None = None
    below: str | None = None
    """The axis that the numbers index."""
    rises_to: str | None = None
    """The numbers are offsets of compressed rows: they increase from 0 to the length of this axis."""
    may_be_nan: bool = False
    """Whether numbers may be NaN or infinite."""
    is_optional: bool = False
    """Whether the file may omit it."""
    is_rotation: bool = False
    """Whether the last two axes are rotation matrices."""


Table = Mapping[str, Expected]
"""By array name; other arrays in a file are rejected."""
Arrays = dict[str, np.ndarray]


def check_arrays(arrays: Mapping[str, np.ndarray], table: Table, **sizes: int) -> Arrays:
    """The arrays, converted to the type and layout for kernels.

    Args:
        arrays: by name.
        table: expected arrays; an axis has the same length in all arrays.
        sizes: known lengths of axes.

    Raises:
        ShapeError: an array is missing, unknown, or not as expected.
    """
    check_names(arrays, table, table)
    known: Sizes = {axis: (length, "the input") for axis, length in sizes.items()}
    out = {name: _of_kind(array, name, table[name], known) for name, array in arrays.items()}
    for name, array in out.items():
        _check_bounds(array, name, table[name], known)
    return out


def require_arrays(arrays: Mapping[str, Any], table: Table, **sizes: int) -> None:
    """Like `check_arrays`, for arrays that are passed to kernels unchanged: none is converted.

    Raises:
        ShapeError: an array is missing, unknown, not a NumPy array, or not as expected.
    """
    found = {name: np.asarray(array) for name, array in arrays.items()}
    for name, array in check_arrays(found, table, **sizes).items():
        if found[name].dtype != array.dtype or (array.ndim and not isinstance(arrays[name], np.ndarray)):
            kind = found[name].dtype if isinstance(arrays[name], np.ndarray) else type(arrays[name]).__name__
            raise ShapeError(f"{name} must be an array of {array.dtype}, got {kind}")


def check_names(names: Iterable[str], table: Table, wanted: Iterable[str]) -> None:
    """Check that the wanted arrays of a table are present, and that there are no unknown ones.

    Raises:
        ShapeError: an array is missing or unknown.
    """
    names = list(names)
    missing = [name for name in wanted if name not in names and not table[name].is_optional]
    if missing:
        raise ShapeError(f"the array {missing[0]!a} is missing")
    unknown = [name for name in names if name not in table]
    if unknown:
        raise ShapeError(f"the array {unknown[0]!a:.60} is unknown")


def _of_kind(array: np.ndarray, name: str, expected: Expected, sizes: Sizes) -> np.ndarray:
    if expected.numbers == TEXT:
        if array.dtype.kind != "U" or not array.dtype.isnative:
            raise ShapeError(f"{name} must be text, got {array.dtype}")
        codes = np.frombuffer(array.tobytes(), np.uint32)
        if ((codes > _LAST_CODE) | ((codes >= _SURROGATES[0]) & (codes <= _SURROGATES[1]))).any():
            raise ShapeError(f"{name} must be text, but contains invalid characters")
    else:
        dtype = np.dtype(expected.numbers)
        if dtype.kind == "f" and array.dtype.newbyteorder("=") != dtype:
            raise ShapeError(f"{name} must be {dtype}, got {array.dtype}")
        array = as_array(array, name, dtype)
    axes = expected.axes.split()
    check_axes(array, name, ["_" if axis.endswith("+1") else axis for axis in axes], sizes)
    for axis, length in zip(axes, array.shape):
        if axis.endswith("+1") and length != 1 + sizes.setdefault(axis[:-2], (length - 1, name))[0]:
            raise ShapeError(f"{name} must be ({', '.join(axes)}), got {array.shape}")
    return array


def _check_rotations(array: np.ndarray, name: str) -> None:
    """Check that matrices that are not all NaN are rotations: R R^T is the identity, and the determinant is positive."""
    own = array[~np.isnan(array).all(axis=(-2, -1))]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(own @ np.swapaxes(own, -2, -1) - np.eye(3))
        if not (off < _ROTATION_TOLERANCE).all() or not (np.linalg.det(own) > 0).all():
            raise ShapeError(f"{name} must be rotation matrices")


def _check_bounds(array: np.ndarray, name: str, expected: Expected, sizes: Sizes) -> None:
    if array.dtype.kind == "f" and not expected.may_be_nan and not np.isfinite(array).all():
        raise ShapeError(f"{name} must be finite")
    least, most = expected.least, expected.most
    if expected.below is not None:
        least, most = least or 0, sizes[expected.below][0] - 1
    if array.size and (
        (least is not None and array.min() < least) or (most is not None and array.max() > most)
    ):
        raise ShapeError(f"{name} must be from {least} to {most}, got {array.min()} to {array.max()}")
    if expected.is_rotation:
        _check_rotations(array, name)
    if expected.rises_to is not None:
        total = sizes[expected.rises_to][0]
        if not len(array) or array[0] != 0 or array[-1] != total or (array[1:] < array[:-1]).any():
            raise ShapeError(f"{name} must increase from 0 to {total}")
