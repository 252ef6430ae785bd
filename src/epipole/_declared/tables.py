"""Arrays that others have made: what each must be stands in a table, and is checked before anything uses it.

Whoever writes a file can compute its digest, too: a digest shows that bytes were not damaged by accident, not that the arrays fit
each other. So every array has an entry in the table of its file: its numbers, its shape with named axes, and its bounds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from epipole._declared.arrays import as_array, check_axes
from epipole._declared.kinds import Sizes
from epipole.errors import ShapeError

TEXT = "str"
_ROTATION_TOLERANCE = 1e-6
_LAST_CODE, _SURROGATES = 0x10FFFF, (0xD800, 0xDFFF)
"""The last character of Unicode, and codes that stand for none."""


@dataclass(frozen=True, slots=True)
class Expected:
    """An array that a file must hold."""

    numbers: str
    """The name of a NumPy type, or `TEXT`; whole numbers of another width are converted if they fit."""
    axes: str = ""
    """Lengths, names that arrays of the file share, one more than such a name (n+1), or _ for any; empty for a single value."""
    least: float | None = None
    most: float | None = None
    below: str | None = None
    """The axis that the numbers are indices of."""
    rises_to: str | None = None
    """The numbers rise from 0 to the length of this axis: offsets of compressed rows."""
    may_be_nan: bool = False
    """Whether numbers may be NaN or infinite."""
    is_optional: bool = False
    """Whether the file may lack it."""
    is_rotation: bool = False
    """Whether the last two axes are rotation matrices."""


Table = Mapping[str, Expected]
"""By the names of arrays; what a file holds besides is refused."""
Arrays = dict[str, np.ndarray]


def check_arrays(arrays: Mapping[str, np.ndarray], table: Table, **sizes: int) -> Arrays:
    """The arrays, each of the type and in the layout that kernels take.

    Args:
        arrays: by name.
        table: what is expected; an axis keeps its length through all arrays.
        sizes: lengths of axes that are known.

    Raises:
        ShapeError: one is missing, unknown, or not as expected.
    """
    check_names(arrays, table, table)
    known: Sizes = {axis: (length, "the input") for axis, length in sizes.items()}
    out = {name: _of_kind(array, name, table[name], known) for name, array in arrays.items()}
    for name, array in out.items():
        _check_bounds(array, name, table[name], known)
    return out


def require_arrays(arrays: Mapping[str, Any], table: Table, **sizes: int) -> None:
    """As `check_arrays`, of arrays that kernels will get as they are: none is converted.

    Raises:
        ShapeError: one is missing, unknown, not a NumPy array, or not as expected.
    """
    found = {name: np.asarray(array) for name, array in arrays.items()}
    for name, array in check_arrays(found, table, **sizes).items():
        if found[name].dtype != array.dtype or (array.ndim and not isinstance(arrays[name], np.ndarray)):
            kind = found[name].dtype if isinstance(arrays[name], np.ndarray) else type(arrays[name]).__name__
            raise ShapeError(f"{name} must be an array of {array.dtype}, got {kind}")


def check_names(names: Iterable[str], table: Table, wanted: Iterable[str]) -> None:
    """Check that the wanted arrays of a table are there, and none that the table does not know.

    Raises:
        ShapeError: one is missing or unknown.
    """
    names = list(names)
    missing = [name for name in wanted if name not in names and not table[name].is_optional]
    if missing:
        raise ShapeError(f"the array {missing[0]!a} is missing")
    unknown = [name for name in names if name not in table]
    if unknown:
        raise ShapeError(f"the array {unknown[0]!a:.60} is not known")


def _of_kind(array: np.ndarray, name: str, expected: Expected, sizes: Sizes) -> np.ndarray:
    if expected.numbers == TEXT:
        if array.dtype.kind != "U" or not array.dtype.isnative:
            raise ShapeError(f"{name} must be text, got {array.dtype}")
        codes = np.frombuffer(array.tobytes(), np.uint32)
        if ((codes > _LAST_CODE) | ((codes >= _SURROGATES[0]) & (codes <= _SURROGATES[1]))).any():
            raise ShapeError(f"{name} must be text, and holds what is no character")
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
    """Of those that are not NaN throughout: R R^T is the identity, and no axis is mirrored."""
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
        raise ShapeError(f"{name} must be within {least} and {most}, got {array.min()} to {array.max()}")
    if expected.is_rotation:
        _check_rotations(array, name)
    if expected.rises_to is not None:
        total = sizes[expected.rises_to][0]
        if not len(array) or array[0] != 0 or array[-1] != total or (array[1:] < array[:-1]).any():
            raise ShapeError(f"{name} must rise from 0 to {total}")
