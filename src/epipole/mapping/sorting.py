"""Sorted sets of integers."""

from __future__ import annotations

import numpy as np


def distinct(keys: np.ndarray) -> np.ndarray:
    """(u,) the different keys in increasing order; for many integers, several times faster than `np.unique`."""
    in_order = np.sort(keys)
    is_first = np.ones(len(in_order), bool)
    is_first[1:] = in_order[1:] != in_order[:-1]
    return np.asarray(in_order[is_first])
