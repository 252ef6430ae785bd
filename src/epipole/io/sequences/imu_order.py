"""The order of an IMU's samples: sorted by time, without repeated times."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError

_MOST_BLOCKS, _OVERLAP_S = 4, 1.0
"""Up to this many steps back in time, with overlaps longer than this (seconds), mean several recordings."""


def in_order(path: Path, values: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Sort rows by time and drop repeated times; also returns notes about both.

    Raises:
        FileFormatError: the rows belong to several recordings.
    """
    times = values[:, 0]
    falls = np.flatnonzero(np.diff(times) < 0) + 1
    blocks = np.split(times, falls)
    if 0 < len(falls) <= _MOST_BLOCKS and len(times) > 2 * len(blocks):
        spans = sorted((float(block[0]), float(block[-1])) for block in blocks)
        if any(later[0] < earlier[1] - _OVERLAP_S for earlier, later in pairwise(spans)):
            raise FileFormatError(
                path,
                f"sample {int(falls[0]) + 1} is earlier than the previous one, and the times from there on overlap with earlier "
                "ones: the file contains several recordings, or the clock was set back. Pass a single recording",
            )
    order = np.argsort(times, kind="stable")
    is_first = np.diff(times[order], prepend=-np.inf) > 0
    said = []
    if len(falls):
        said.append(
            f"{path.name}: {len(falls)} samples are earlier than the previous one; all were sorted by time"
        )
    if not is_first.all():
        said.append(
            f"{path.name}: {int((~is_first).sum())} samples repeat a time; only the first of each is used"
        )
    return values[order[is_first]], tuple(said)
