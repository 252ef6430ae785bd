"""Combinations of values of which every pair occurs together."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

from whole import IS_WHOLE


def pairs_of(row: Sequence[int]) -> set[tuple[tuple[int, int], ...]]:
    return set(itertools.combinations(enumerate(row), 2))


def pairwise(*values: Sequence[Any]) -> Iterator[tuple[Any, ...]]:
    """A sample of their product in which every two values of different factors occur together; all of it where the tests are whole."""
    rows = list(itertools.product(*map(range, map(len, values))))
    left = set().union(*map(pairs_of, rows))
    while rows and (left or IS_WHOLE):
        row = rows[0] if IS_WHOLE else max(rows, key=lambda row: len(pairs_of(row) & left))
        rows.remove(row)
        left -= pairs_of(row)
        yield tuple(given[k] for given, k in zip(values, row))


def each_once(*values: Sequence[Any]) -> list[tuple[Any, ...]]:
    """A row for each of the first values, in which the others count through their product; all of it where the tests are whole."""
    if IS_WHOLE:
        return list(itertools.product(*values))
    rows = []
    for number, first in enumerate(values[0]):
        digits, left = [], number
        for given in values[1:]:
            digits.append(given[left % len(given)])
            left //= len(given)
        rows.append((first, *digits))
    return rows
