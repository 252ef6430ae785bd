"""Mapping in a thread: adjustment and loop closure on a copy of the map, while tracking goes on in the original."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from copy import copy
from typing import NamedTuple

from epipole._parallel import inline_here
from epipole.pipelines.slam.loops.closing import LoopCloser, LoopConstraint
from epipole.pipelines.slam.loops.correction import close_in_map
from epipole.pipelines.slam.loops.recognition import describe_keyframe
from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.pipelines.slam.map.map_copy import MapCopy
from epipole.pipelines.slam.map.slam_map import SlamMap

MOST_WAITING = 1
"""Keyframes that may wait for mapping; with as many, only a large loss of points makes a frame a keyframe."""


class Mapped(NamedTuple):
    """Result of mapping."""

    copied: MapCopy
    mapper: LocalMapper
    """Of the copy."""
    joining: LoopConstraint | None
    """A loop between this map and another one."""
    num_keyframes: int
    """Keyframes that were inserted since the copy before."""


class MappingThread:
    """Maps one copy after another; a copy contains all keyframes that were inserted since the one before.

    Attributes:
        num_merged: keyframes that were mapped together with a later one, since mapping was behind.
        num_waiting: keyframes inserted since the present copy.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="epipole-mapping")
        self._running: Future[Mapped] | None = None
        self.num_merged = self.num_waiting = 0

    @property
    def is_behind(self) -> bool:
        """Whether too many keyframes wait."""
        return self._running is not None and self.num_waiting >= MOST_WAITING

    def add(self, mapper: LocalMapper, closer: LoopCloser, maps: Sequence[SlamMap]) -> None:
        """Map the newest keyframe, or let it wait until the thread is free.

        Args:
            mapper: of the tracked map.
            closer: searches loops; not used elsewhere until the result is taken.
            maps: all maps, in which loops are searched.
        """
        self.num_waiting += 1
        if self._running is None:
            self._start(mapper, closer, maps)

    def catch_up(self, mapper: LocalMapper, closer: LoopCloser, maps: Sequence[SlamMap]) -> None:
        """Map the keyframes that wait, if the thread is free."""
        if self._running is None and self.num_waiting:
            self._start(mapper, closer, maps)

    def _start(self, mapper: LocalMapper, closer: LoopCloser, maps: Sequence[SlamMap]) -> None:
        copied = MapCopy(mapper.map)
        count, self.num_waiting = self.num_waiting, 0
        self.num_merged += count - 1
        closer.move_candidates(mapper.map, copied.map)
        beside = copy(mapper)
        beside.map = copied.map
        seen = [copied.map if model is mapper.map else model for model in maps]
        self._running = self._pool.submit(_mapped, copied, beside, closer, seen, count)

    def take(self, *, wait: bool = False) -> Mapped | None:
        """The result, once; None while the thread works (unless `wait`), and if it has nothing to do.

        Raises:
            Exception: an error of the thread.
        """
        if self._running is None or not (wait or self._running.done()):
            return None
        running = self._running
        try:
            return running.result()
        finally:  # an interrupted wait leaves the thread at work
            self._running = None if running.done() else running

    def discard(self) -> None:
        """Wait for the thread, and leave out its result and what waits: their map is discarded."""
        if self._running is not None:
            wait([self._running])
        self._running, self.num_waiting = None, 0


def _mapped(
    copied: MapCopy, mapper: LocalMapper, closer: LoopCloser, maps: Sequence[SlamMap], num_keyframes: int
) -> Mapped:
    """Adjust the map around its newest keyframe, and close a loop."""
    # Tracking needs the other processors.
    with inline_here():
        mapper.adjust_around(len(copied.map.keyframes) - 1)
        for keyframe in copied.map.keyframes:
            if keyframe.descriptor is None and len(keyframe.point):
                describe_keyframe(keyframe)
        joining: LoopConstraint | None = None

        def is_closed(constraint: LoopConstraint) -> bool:
            nonlocal joining
            if constraint.there is not copied.map:
                joining = constraint
                return True
            into = close_in_map(mapper, closer, constraint)
            copied.into = copied.into if into is None else into
            return into is not None

        closer.search(copied.map, maps, is_closed)
    return Mapped(copied, mapper, joining, num_keyframes)
