"""Base of batched rotations, motions and similarities: arrays with common leading axes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, ClassVar, TypeVar

import numpy as np

from epipole._checks.arrays import as_array
from epipole.errors import ShapeError

Own = TypeVar("Own", bound="Batch")
_DOUBLE = np.dtype(np.float64)
MOST_OFF = 1e-3
"""Largest accepted deviation of R R^T from the identity: enough for single precision, or four copied digits."""
FEW = 9 * 8
"""Largest count of numbers that plain Python checks faster than arrays."""


class NotABatchError(ShapeError, TypeError):
    """A single item was given where a batch is needed; also a `TypeError`, as Python's `len` raises."""


class Batch:
    """A data class of arrays with common leading axes, the batch; `_items` are each field's other axes."""

    __slots__: ClassVar[tuple[str, ...]] = ()
    _items: ClassVar[tuple[tuple[int, ...], ...]] = ()
    _rotations: ClassVar[str | None] = None
    """The field of rotation matrices, if any."""

    def __post_init__(self) -> None:
        """Check the fields, and convert numbers of other types to double precision.

        Raises:
            ShapeError: a field has the wrong trailing axes, the batch shapes differ, or a matrix is not a rotation.
        """
        self._check_shapes()
        if self._rotations is not None:
            check_rotations(getattr(self, self._rotations), self._rotations)

    @classmethod
    def stack(cls: type[Own], items: Iterable[Own]) -> Own:
        """Stack single items, or batches of one shape, along a new first axis.

        Raises:
            ShapeError: there are no items, an item has the wrong type, or their shapes differ.
        """
        each = list(items)
        wrong = [type(item).__name__ for item in each if not isinstance(item, cls)]
        if not each or wrong:
            raise ShapeError(
                f"items must be at least one {cls.__name__}, got {wrong[0] if wrong else 'none'}"
            )
        shapes = {item.batch_shape() for item in each}
        if len(shapes) > 1:
            raise ShapeError(f"items must have the same batch shape, got {sorted(shapes)}")
        return cls._of(*(np.stack([getattr(item, name) for item in each]) for name in cls.__slots__))

    @classmethod
    def _of(cls: type[Own], *fields: np.ndarray) -> Own:
        """Create from fields computed from valid ones, without checking the matrices again."""
        out: Own = object.__new__(cls)
        for name, value in zip(cls.__slots__, fields):
            object.__setattr__(out, name, value)
        out._check_shapes()
        return out

    def _check_shapes(self) -> None:
        batch: tuple[int, ...] | None = None
        for name, item in zip(self.__slots__, self._items):
            value = getattr(self, name)
            if type(value) is not np.ndarray or value.dtype != _DOUBLE:
                value = as_array(value, name, _DOUBLE)
                object.__setattr__(self, name, value)
            axes = value.ndim - len(item)
            if axes < 0 or value.shape[axes:] != item:
                wanted = ", ".join(map(str, ("...", *item)))
                raise ShapeError(f"{name} must have shape ({wanted}), got {value.shape}")
            if batch is not None and value.shape[:axes] != batch:
                raise ShapeError(
                    f"{name} must have the same batch shape {batch} as the other fields, got {value.shape[:axes]}"
                )
            batch = value.shape[:axes]

    def batch_shape(self) -> tuple[int, ...]:
        """The common leading axes; () for a single item."""
        last = getattr(self, self.__slots__[-1])
        return tuple(last.shape[: last.ndim - len(self._items[-1])])

    def check_fits(self, shape: tuple[int, ...], name: str) -> None:
        """Check that another batch can be broadcast with this one.

        Raises:
            ShapeError: it cannot be broadcast.
        """
        own = self.batch_shape()
        if own == shape or not own or not shape:
            return
        try:
            np.broadcast_shapes(own, shape)
        except ValueError as error:
            raise ShapeError(
                f"{name} with batch shape {shape} cannot be broadcast with batch shape {own}"
            ) from error

    def __getitem__(self: Own, index: Any) -> Own:
        """Select from the batch."""
        if not self.batch_shape():
            np.empty(())[index]  # raises for all indices but None and ...
        return type(self)._of(*(np.asarray(getattr(self, name)[index]) for name in self.__slots__))

    def __len__(self) -> int:
        if not self.batch_shape():
            kind = type(self).__name__
            raise NotABatchError(f"a batch is needed, as {kind}.stack([one, other]), got a single {kind}")
        return len(getattr(self, self.__slots__[-1]))

    def __iter__(self: Own) -> Iterator[Own]:
        return map(self.__getitem__, range(len(self)))

    def __bool__(self) -> bool:
        return not self.batch_shape() or len(self) > 0

    def __repr__(self) -> str:
        shape = self.batch_shape()
        if shape:
            words = f"batch of {' x '.join(map(str, shape))}"
        elif all(np.isfinite(getattr(self, name)).all() for name in self.__slots__):
            words = self._in_words()
        else:
            words = "unknown"
        return f"{type(self).__name__}({words})"

    def _in_words(self) -> str:
        """The values of a single item, for printing."""
        return ", ".join(f"{name} {in_words(getattr(self, name))}" for name in self.__slots__)


def check_rotations(matrices: np.ndarray, name: str) -> None:
    """Check that (..., 3, 3) matrices are orthonormal and right-handed; NaN matrices (unknown) are accepted.

    Raises:
        ShapeError: a matrix is not a rotation.
    """
    if matrices.size <= FEW:
        off, is_mirror = _off_of_few(matrices)
    else:
        with np.errstate(invalid="ignore", over="ignore"):
            gram = np.abs(matrices @ np.swapaxes(matrices, -1, -2) - np.eye(3))
            along = np.sum(np.cross(matrices[..., 0, :], matrices[..., 1, :]) * matrices[..., 2, :], axis=-1)
        off, is_mirror = float(np.max(gram, initial=0.0, where=~np.isnan(gram))), bool(np.any(along < 0.0))
    if off > MOST_OFF or is_mirror:
        reason = f"R R^T differs from the identity by {off:.2g}" if off > MOST_OFF else "one is a reflection"
        hint = "Rotation3.nearest(matrix) gives the nearest one"
        raise ShapeError(f"{name} must be rotation matrices: {reason} ({hint})")


def _off_of_few(matrices: np.ndarray) -> tuple[float, bool]:
    """Largest deviation of R R^T from the identity, and whether one is a reflection; for few matrices faster than with arrays."""
    largest, is_mirror = 0.0, False
    for (a, b, c), (d, e, f), (g, h, i) in matrices.reshape(-1, 3, 3).tolist():
        sizes = a * a + b * b + c * c - 1.0, d * d + e * e + f * f - 1.0, g * g + h * h + i * i - 1.0
        angles = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
        off = max(*map(abs, sizes), *map(abs, angles))
        if off != off:  # NaN hides the others
            off = max((abs(value) for value in (*sizes, *angles) if value == value), default=0.0)
        largest = max(largest, off)
        is_mirror |= a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0.0
    return largest, is_mirror


def in_words(values: Any) -> str:
    """A number or a vector with four digits."""
    numbers = [f"{value + 0.0:.4g}" for value in np.atleast_1d(values).ravel()]
    return f"({', '.join(numbers)})" if np.ndim(values) else numbers[0]
