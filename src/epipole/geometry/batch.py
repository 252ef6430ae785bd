"""What rotations, motions and similarities share: a batch of them is arrays with common first axes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, TypeVar

import numpy as np

from epipole._declared.arrays import as_array
from epipole.errors import ShapeError

Own = TypeVar("Own", bound="Batch")
_DOUBLE = np.dtype(np.float64)


class Batch:
    """A data class of arrays whose first axes, the batch, are the same; `_items` are each field's others."""

    __slots__: ClassVar[tuple[str, ...]] = ()
    _items: ClassVar[tuple[tuple[int, ...], ...]] = ()

    def __post_init__(self) -> None:
        """Check the fields; numbers of other types become double.

        Raises:
            ShapeError: a field has other axes than its items', or the batches differ.
        """
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
                    f"{name} must have the batch shape {batch} of the others, got {value.shape[:axes]}"
                )
            batch = value.shape[:axes]

    def batch_shape(self) -> tuple[int, ...]:
        """The common first axes; () for a single one."""
        last = getattr(self, self.__slots__[-1])
        return tuple(last.shape[: last.ndim - len(self._items[-1])])

    def check_fits(self, shape: tuple[int, ...], name: str) -> None:
        """Check that another batch can be broadcast with this one.

        Raises:
            ShapeError: it cannot.
        """
        own = self.batch_shape()
        if own == shape or not own or not shape:
            return
        try:
            np.broadcast_shapes(own, shape)
        except ValueError as error:
            raise ShapeError(f"{name} of batch shape {shape} do not fit a batch of {own}") from error

    def __getitem__(self: Own, index: Any) -> Own:
        """Select from the batch."""
        if not self.batch_shape():
            np.empty(())[index]  # an array without axes knows which indices it has: None and ... alone
        return type(self)(*(np.asarray(getattr(self, name)[index]) for name in self.__slots__))

    def __len__(self) -> int:
        if not self.batch_shape():
            raise TypeError(f"a single {type(self).__name__} has no length")
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
            words = "not known"
        return f"{type(self).__name__}({words})"

    def _in_words(self) -> str:
        """A single one's values, for people."""
        return ", ".join(f"{name} {in_words(getattr(self, name))}" for name in self.__slots__)


def in_words(values: Any) -> str:
    """A number or a vector in a few digits."""
    numbers = [f"{value + 0.0:.4g}" for value in np.atleast_1d(values).ravel()]
    return f"({', '.join(numbers)})" if np.ndim(values) else numbers[0]
