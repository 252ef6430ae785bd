"""The map beside tracking: taking over what the mapping thread has done, and loop closure."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from itertools import combinations

import numpy as np

from epipole.pipelines.slam.frames import TrackingState
from epipole.pipelines.slam.loops.closing import LoopConstraint
from epipole.pipelines.slam.loops.correction import close_in_map, refine_closed
from epipole.pipelines.slam.loops.merging import join_maps
from epipole.pipelines.slam.loops.recognition import describe_keyframe
from epipole.pipelines.slam.map.map_copy import Change, world_motion
from epipole.pipelines.slam.mapping_thread import Mapped, MappingThread
from epipole.pipelines.slam.slam_state import SlamState


class SlamMapping(SlamState):
    """The steps of `Slam` that change the map as a whole."""

    # Mapping beside tracking.

    def wait_for_mapping(self, *, is_urgent: bool = False) -> None:
        """Wait until all keyframes are mapped, if a thread maps them; if urgent, adjustments end after their present step."""
        if (thread := self.mapping_thread) is not None:
            thread.is_urgent = is_urgent
            try:
                self._take_over_mapping(wait=True)
            finally:
                thread.is_urgent = False

    def _take_over_mapping(self, *, wait: bool = False) -> None:
        """Take the result of the mapping thread, if it has one, and let it go on with the keyframes that wait.

        Frames between two results are tracked in the map as it was; one step then replaces it and moves the pose with it.
        """
        if self.mapping_thread is None or not self._has_points(self.mapping_thread, wait=wait):
            return
        while (done := self._mapped(wait=wait)) is not None:
            self.odometry.mapper.num_optimized = done.mapper.num_optimized
            self._closer.move_candidates(done.copied.map, self.map)
            self.odometry.take_over(done.copied.replace_original())
            if done.joining is not None:
                change = self._joined(done.joining)  # may enter the other map
                self.odometry.take_over(change)
            for _ in range(done.num_keyframes):
                self._refine_past()
            self.mapping_thread.catch_up(self.odometry.mapper, self._closer, self.maps)
        self.odometry.is_mapping_behind = self.mapping_thread.is_behind

    def _has_points(self, thread: MappingThread, *, wait: bool) -> bool:
        """Whether the newest keyframe has its points; if the thread has just found them, they are tracked and mapped."""
        try:
            seen = thread.take_points(wait=wait)
            if seen is not None:
                self.odometry.complete_keyframe(seen, None if thread.is_urgent else self._before)
        finally:
            if self.odometry.is_incomplete and not thread.is_searching:
                self.odometry.is_incomplete = False
                thread.add(self.odometry.mapper, self._closer, self.maps)
        return not thread.is_searching

    def _mapped(self, *, wait: bool) -> Mapped | None:
        """The result of the mapping thread; after an error it goes on with the keyframes that wait."""
        assert self.mapping_thread is not None
        try:
            return self.mapping_thread.take(wait=wait)
        except Exception:
            self._closer.clear()
            self.mapping_thread.catch_up(self.odometry.mapper, self._closer, self.maps)
            raise

    # Loop closure.

    def _close_loop(self) -> str:
        """Correct the map, or join two maps, if the newest keyframe closes a loop; returns the keyframe's reason."""
        describe_keyframe(self.map.keyframes[-1])
        return "a loop was closed" if self._closer.search(self.map, self.maps, self._is_closed) else ""

    def _is_closed(self, constraint: LoopConstraint) -> bool:
        if constraint.there is not self.map:
            self._continue_corrected(self._joined(constraint).into)
            return True
        into = close_in_map(self.odometry.mapper, self._closer, constraint)
        if into is not None:
            self._continue_corrected(into)
        return into is not None

    def _joined(self, constraint: LoopConstraint) -> Change:
        """Merge the younger map into the older one, in whose world results are given; how that changes the newest keyframe."""
        here, there, tracks = self.map, constraint.there, self.odometry.tracker.tracks
        newest, before = here.keyframes[-1], copy(here.keyframes[-1])
        if self.maps.index(there) < self.maps.index(here):
            here.move(constraint.there_from_here)
            tracks.point = tracks.point + there.absorb(here)
            self.maps.remove(here)
            self._enter(there)
            self.odometry.tracker.tracks = tracks
        else:
            there.move(constraint.there_from_here.inverse())
            here.absorb(there)
            self.maps.remove(there)
        self._set_tracking()
        self._unconfirmed = None
        before.point = newest.point
        into = refine_closed(self.odometry.mapper)
        return Change(world_motion(before, newest), into, np.setdiff1d(into[before.point], newest.point))

    def _join_separate_maps(self, goes_on: Callable[[], bool]) -> None:
        """Join maps by any of their keyframes; while the camera is tracked, only the newest keyframe is compared with other maps."""
        pairs = list(combinations(self.maps, 2))
        while pairs and goes_on():
            there, here = pairs.pop(0)
            are_full = all(any(len(k.point) for k in model.keyframes) for model in (there, here))
            if not are_full or join_maps(there, here, self.camera, self.config, self.loops):
                continue
            self.maps.remove(here)
            if self.map is here or self.map is there:
                self._enter(there)
                self.state = TrackingState.LOST  # until the next frame is relocalized
            # The larger map may have something in common with maps that were compared with its parts.
            pairs = [pair for pair in combinations(self.maps, 2) if there in pair or pair in pairs]

    def _continue_corrected(self, into: np.ndarray) -> None:
        """Go on from the newest keyframe of a corrected map, with the new row of each point."""
        self.odometry.tracker.rename(into)
        self.odometry.tracker.remove_outliers()
        self.odometry.cam_from_world = self.map.keyframes[-1].cam_from_world
        if self.odometry.inertial is not None:
            self.odometry.inertial.clear()

    def _set_tracking(self) -> None:
        self.state = TrackingState.TRACKING if self.map is self.maps[0] else TrackingState.SUBMAP
        self._num_lost, self._rotation, self._rig_start = 0, None, None
        self._relocalizer.clear()
