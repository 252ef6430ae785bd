"""Preallocated arrays of Gaussians, whose rows are added and removed in place to save memory."""

from __future__ import annotations

import numpy as np

from epipole.fields.splat.rasterizer import Cloud


class GrowingCloud:
    """A cloud, or arrays of the same shapes, with spare capacity.

    Attributes:
        cloud: its rows, as views that become invalid with the next change.
    """

    def __init__(self, cloud: Cloud, most: int) -> None:
        """Copy a cloud; there is room for `most` rows."""
        self._most = max(most, len(cloud.means))
        # Pages that are never written to take no memory.
        self._room = Cloud(*(np.empty((self._most, *part.shape[1:]), np.float32) for part in cloud))
        self._count = len(cloud.means)
        for room, part in zip(self._room, cloud):
            room[: self._count] = part
        self.cloud = self._rows()

    def _rows(self) -> Cloud:
        return Cloud(*(part[: self._count] for part in self._room))

    def raise_degree(self, num_sh: int) -> None:
        """Make room for `num_sh` harmonics; new ones are 0."""
        old = self._room.sh
        sh = np.empty((self._most, num_sh, 3), np.float32)
        sh[: self._count, : old.shape[1]] = old[: self._count]
        sh[: self._count, old.shape[1] :] = 0.0
        self._room = self._room._replace(sh=sh)
        self.cloud = self._rows()

    def change(self, gone: np.ndarray, more: Cloud) -> None:
        """Put new rows in place of removed ones. Append the rest, or fill remaining holes from the end.

        Args:
            gone: rows to remove, in ascending order.
            more: new rows.
        """
        count, new = self._count, len(more.means)
        filled, holes = gone[:new], gone[new:]
        end = count + max(0, new - len(gone)) - len(holes)
        moved = np.setdiff1d(np.arange(end, count), holes)
        holes = holes[holes < end]
        for room, part in zip(self._room, more):
            room[filled] = part[: len(filled)]
            room[count : count + new - len(filled)] = part[len(filled) :]
            room[holes] = room[moved]
        self._count = end
        self.cloud = self._rows()
