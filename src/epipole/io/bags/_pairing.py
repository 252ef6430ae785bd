"""Streaming synchronization of messages from several topics."""

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


def grouped(
    items: Iterable[tuple[int, float, Item]], num_topics: int, tolerance_s: float
) -> Iterator[tuple[float, tuple[Item, ...]]]:
    """Yield the first topic's time and an item of each topic whose times differ by at most the tolerance.

    Args:
        items: (topic, seconds, item); times increase within each topic, but topics may lag behind others.
        num_topics: number of topics; they are numbered from 0.
        tolerance_s: largest difference in time, less than half the time between two items of a topic.
    """
    waiting: list[deque[tuple[float, Item]]] = [deque() for _ in range(num_topics)]
    for topic, time_s, item in items:
        waiting[topic].append((time_s, item))
        if len(waiting[topic]) > _MOST_WAITING:
            waiting[topic].popleft()
        while all(waiting):
            newest_s = max(queue[0][0] for queue in waiting)
            late = [queue for queue in waiting if queue[0][0] < newest_s - tolerance_s]
            if not late:
                yield waiting[0][0][0], tuple(queue.popleft()[1] for queue in waiting)
            for queue in late:
                queue.popleft()
