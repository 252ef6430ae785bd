"""What rotations, motions and similarities share: a batch of them is arrays with common first axes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, TypeVar

import numpy as np

Own = TypeVar("Own", bound="Batch")


class Batch:
    """A data class of arrays whose first axes, the batch, are the same; its last field ends in `_item_axes` others."""

    __slots__: ClassVar[tuple[str, ...]] = ()
    _item_axes: ClassVar[int] = 1

    def batch_shape(self) -> tuple[int, ...]:
        """The common first axes; () for a single one."""
        last = getattr(self, self.__slots__[-1])
        return tuple(last.shape[: last.ndim - self._item_axes])

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
