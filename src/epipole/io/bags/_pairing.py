"""Streaming synchronization of messages from two topics."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")
_MOST_WAITING = 100
"""Most messages of one topic that wait for the other; beyond, the oldest is dropped without a partner."""


def paired(
    items: Iterable[tuple[int, float, Item]], tolerance_s: float
) -> Iterator[tuple[float, Item, Item]]:
    """Yield the first topic's time and two items, each the other's nearest in time within the tolerance.

    Args:
        items: (topic 0 or 1, seconds, item); times increase within each topic, but one topic may lag behind the other.
        tolerance_s: largest difference in time.
    """
    waiting: tuple[deque[tuple[float, Item]], deque[tuple[float, Item]]] = (deque(), deque())
    for topic, time_s, item in items:
        waiting[topic].append((time_s, item))
        yield from _decided(waiting, tolerance_s, is_end=False)
        if len(waiting[topic]) > _MOST_WAITING:
            waiting[topic].popleft()
    yield from _decided(waiting, tolerance_s, is_end=True)


def _decided(
    waiting: tuple[deque[tuple[float, Item]], deque[tuple[float, Item]]], tolerance_s: float, *, is_end: bool
) -> Iterator[tuple[float, Item, Item]]:
    """Remove from the queues everything that can already be decided."""
    first, second = waiting
    while first and second:
        later_s = second[0][0] - first[0][0]
        earlier = first if later_s > 0 else second
        if abs(later_s) > tolerance_s:
            earlier.popleft()
            continue
        # The next message of the earlier topic may be nearer to the other topic's.
        if later_s and len(earlier) < 2 and not is_end:
            return
        other = second if earlier is first else first
        if later_s and len(earlier) > 1 and abs(earlier[1][0] - other[0][0]) < abs(later_s):
            earlier.popleft()
            continue
        time_s, item = first.popleft()
        yield time_s, item, second.popleft()[1]
