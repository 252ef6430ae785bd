"""Mapping in threads, while tracking goes on: the search for a keyframe's points, then adjustment and loop closure on a copy of the map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from copy import copy
from typing import Any, NamedTuple

from epipole._parallel import inline_here, lower_priority_here
from epipole.pipelines.slam.loops.closing import LoopCloser, LoopConstraint
from epipole.pipelines.slam.loops.correction import close_in_map
from epipole.pipelines.slam.loops.recognition import describe_keyframe
from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.pipelines.slam.map.map_copy import MapCopy
from epipole.pipelines.slam.map.slam_map import Observations, SlamMap
from epipole.pipelines.slam.map.triangulation import triangulate

MOST_WAITING = 1
"""Keyframes that may wait for mapping; with as many, only a large loss of points makes a frame a keyframe."""
LONGEST_WAIT_S = 0.05
"""Longest time that a frame waits for mapping if more keyframes wait. Without it, the map of one camera drifts: 40 cm instead of 4 in a
kitchen."""

NICENESS = 3
"""Priority of mapping below that of tracking and of the search for points, which tracking needs soon: with two processors for three threads,
5 % of the frames of a kitchen took 31 ms or more, 35 without it. A thread with 10 waits so long on a busy machine, while it has the
interpreter's lock, that frames wait 2 s for it."""


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
    """Searches points of one keyframe at a time, and maps one copy after another.

    A copy contains all keyframes that were completed since the one before. The search does not wait for mapping, since tracking
    needs the points.

    Attributes:
        num_merged: keyframes that were mapped together with a later one, since mapping was behind.
        num_waiting: keyframes inserted since the present copy.
        judges: compares motions that explain the first images of one camera.
        is_urgent: whether adjustments end after their present step, since a frame of a lost camera waits for them.
    """

    def __init__(self) -> None:
        self._pool = _single_thread("epipole-mapping")
        self._running: Future[Mapped] | None = None
        self._searchers = ThreadPoolExecutor(1, "epipole-points")
        self._search: Future[Observations] | None = None
        self.judges = _single_thread("epipole-start")
        self.num_merged = self.num_waiting = 0
        self.is_urgent = False

    def _goes_on(self) -> bool:
        return not self.is_urgent and self.num_waiting <= MOST_WAITING

    @property
    def is_behind(self) -> bool:
        """Whether too many keyframes wait."""
        return self._running is not None and self.num_waiting >= MOST_WAITING

    @property
    def is_searching(self) -> bool:
        """Whether points of the newest keyframe are searched, or not taken yet; the map must not change until then."""
        return self._search is not None

    def search(self, find_points: Callable[[], Observations]) -> None:
        """Search points of the newest keyframe."""
        self._search = self._searchers.submit(_searched, find_points)

    def take_points(self, *, wait: bool = False) -> Observations | None:
        """The points of the newest keyframe, once; None while they are searched (unless `wait`), and without a search.

        Raises:
            Exception: an error of the search.
        """
        if self._search is None or not (wait or self._search.done()):
            return None
        search = self._search
        try:
            return search.result()
        finally:
            self._search = None if search.done() else search

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
        beside.map, beside.goes_on = copied.map, self._goes_on
        seen = [copied.map if model is mapper.map else model for model in maps]
        self._running = self._pool.submit(_mapped, copied, beside, closer, seen, count)

    def take(self, *, wait: bool = False) -> Mapped | None:
        """The result, once; None while the thread works (unless `wait`), and if it has nothing to do.

        Raises:
            Exception: an error of the thread.
        """
        if self._running is None:
            return None
        if not wait and self.num_waiting > MOST_WAITING:
            wait_for([self._running], LONGEST_WAIT_S)
        if not (wait or self._running.done()):
            return None
        running = self._running
        try:
            return running.result()
        finally:  # an interrupted wait leaves the thread at work
            self._running = None if running.done() else running

    def discard(self) -> None:
        """Wait for the threads, and leave out their results and what waits: their map is discarded."""
        running: list[Future[Any]] = [one for one in (self._running, self._search) if one is not None]
        self.is_urgent = True
        try:
            wait_for(running)
        finally:
            self.is_urgent = False
        self._running, self._search, self.num_waiting = None, None, 0


def _single_thread(name: str) -> ThreadPoolExecutor:
    """A thread with a lower priority."""
    return ThreadPoolExecutor(1, name, lower_priority_here, (NICENESS,))


def _searched(find_points: Callable[[], Observations]) -> Observations:
    with inline_here():
        return find_points()


def _mapped(
    copied: MapCopy, mapper: LocalMapper, closer: LoopCloser, maps: Sequence[SlamMap], num_keyframes: int
) -> Mapped:
    """Adjust the map around its newest keyframe, and close a loop."""
    # Tracking needs the other processors.
    with inline_here():
        for newest in range(len(copied.map.keyframes) - num_keyframes, len(copied.map.keyframes)):
            triangulate(copied.map, mapper.camera, mapper.config, newest)
        mapper.adjust_around(len(copied.map.keyframes) - 1)
        # A map that a loop corrects is adjusted to the end, before outliers are removed.
        mapper.goes_on = lambda: True
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
