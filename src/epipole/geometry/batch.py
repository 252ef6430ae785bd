"""What rotations, motions and similarities share: a batch of them is arrays with common first axes."""

from __future__ import annotations

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
        return type(self)(*(np.asarray(getattr(self, name)[index]) for name in self.__slots__))

    def __len__(self) -> int:
        return len(getattr(self, self.__slots__[-1]))

    def __repr__(self) -> str:
        return f"{type(self).__name__}(batch {self.batch_shape()})"
