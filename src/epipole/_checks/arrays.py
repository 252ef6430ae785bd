"""Arrays for kernels: of one type, C-contiguous, aligned, writeable and in native byte order."""

from __future__ import annotations

from typing import Any

import numpy as np

from epipole._checks.kinds import Convert, Sizes
from epipole.errors import ShapeError

_WORDS = {"f": "numbers", "i": "whole numbers", "u": "whole numbers", "b": "True or False"}
_NUMBERS = ("float64", "float32", "int64", "int32", "int16", "uint64", "uint32", "uint16", "uint8")
_ALLOWED = {"f": "biuf", "i": "iu", "u": "iu", "b": "b"}


def as_array(value: Any, name: str, dtype: np.dtype[Any]) -> np.ndarray:
    """The value as an array of this type, in the layout above; itself if it already is one.

    Read-only arrays are copied, as kernels are compiled for writeable arrays only.

    Raises:
        ShapeError: it has values of another kind, or beyond the type's range.
    """
    if type(value) is np.ndarray and value.dtype == dtype and value.flags.carray:
        return value
    try:
        given = np.asarray(value)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ShapeError(f"{name} must be an array of {_WORDS[dtype.kind]}: {error}") from error
    if given.dtype.kind not in _ALLOWED[dtype.kind] and not (given.size == 0 and given.dtype.kind in "biuf"):
        came = given.dtype if given.dtype.kind != "O" or given.ndim else _one_thing(value, name)
        raise ShapeError(f"{name} must be an array of {_WORDS[dtype.kind]}, got {came}")
    if dtype.kind in "iu" and given.dtype != dtype and given.size:
        low, high = int(given.min()), int(given.max())
        limits = np.iinfo(dtype)
        if low < limits.min or high > limits.max:
            raise ShapeError(f"{name} must be from {limits.min} to {limits.max}, got {low} to {high}")
    with np.errstate(over="ignore"):  # a double beyond the range of single precision becomes infinite
        return np.require(given, dtype, ["C", "A", "W"])


def _one_thing(value: Any, name: str) -> str:
    """Description of a non-array argument; if it has an attribute with the argument's name, suggest that."""
    own = name.rstrip("0123456789")
    kind = type(value).__name__
    return f"{kind}: pass its .{own}" if hasattr(value, own) else kind


def array_converter(annotation: Any) -> Convert:
    """The converter for a jaxtyping annotation: kind of numbers, axes, and lengths shared between axes."""
    kinds = {np.dtype(name) for name in annotation.dtypes if name in ("bool", *_NUMBERS)}
    only = kinds.pop() if len(kinds) == 1 else None
    axes = annotation.dim_str.split()

    def convert(value: Any, name: str, sizes: Sizes) -> np.ndarray:
        array = as_array(value, name, only or _kept_type(value))
        check_axes(array, name, axes, sizes)
        return array

    return convert


def check_axes(array: np.ndarray, name: str, axes: list[str], sizes: Sizes) -> None:
    """Check the shape of an array, and record the lengths of its named axes.

    Raises:
        ShapeError: it has other axes, or an axis differs in length from one of the same name.
    """
    shape, named = array.shape, axes
    variadic = next((k for k, axis in enumerate(axes) if axis.startswith(("*", "..."))), None)
    if variadic is not None and len(shape) >= len(axes) - 1:
        named = [*axes[:variadic], *["_"] * (len(shape) - len(axes) + 1), *axes[variadic + 1 :]]
    if len(shape) != len(named):
        raise ShapeError(f"{name} must be ({', '.join(axes)}), got {shape}{_hint(axes, shape)}")
    for axis, length in zip(named, shape):
        _check_axis(axis, length, name, axes, shape, sizes)


def _hint(axes: list[str], shape: tuple[int, ...]) -> str:
    """Hint for the usual causes of an extra axis: a color image, or OpenCV's points."""
    if axes == ["h", "w"] and len(shape) == 3:
        return "; a color image? Convert it with cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)"
    if len(axes) == 2 and len(shape) == 3 and 1 in shape[:2]:
        return f"; OpenCV's points? .reshape(-1, {shape[2]})"
    return ""


def _check_axis(
    axis: str, length: int, name: str, axes: list[str], shape: tuple[int, ...], sizes: Sizes
) -> None:
    if axis.isdecimal():
        if length != int(axis):
            raise ShapeError(f"{name} must be ({', '.join(axes)}), got {shape}")
    elif axis.isidentifier() and axis != "_":
        known, other = sizes.setdefault(axis, (length, name))
        if known != length:
            raise ShapeError(
                f"{name} must be ({', '.join(axes)}) with {axis} = {known} (as in {other}), got {shape}"
            )


def _kept_type(value: Any) -> np.dtype[Any]:
    """For annotations of any floating-point type: single precision is kept, everything else becomes double."""
    given = getattr(value, "dtype", None)
    return np.dtype(np.float32 if given == np.float32 else np.float64)
