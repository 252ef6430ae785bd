"""Start of a map with a rig whose cameras see too few points together: each camera alone, until their motions show the scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import NamedTuple, Protocol

import numpy as np

from epipole.geometry import Rigid3, Similarity3
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackedFrame
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap
from epipole.pipelines.slam.start.rig_scale import RigScales, fit_rig_scales
from epipole.pipelines.slam.tracking.points import Tracks
from epipole.scene import CameraRig, Trajectory

TOO_FEW = "the cameras see too few points together"
LEAST_FRAMES = 15
"""Frames that two cameras must have localized."""
EVERY = 5
"""Frames between two attempts."""
PATIENCE = 10
"""Frames after which a lost camera starts again."""
MOST_KEYFRAMES = 100
"""Keyframes after which a camera starts again, so that a long straight ride does not fill the memory."""
KEPT = 100
"""Latest frames that are kept, since a camera's map may start from earlier frames."""
LARGEST_SIGMA = 0.08
"""Relative standard deviation of an accepted scale; the adjustments of the rig's map make it smaller."""
LARGEST_ROTATION_DEG, LARGEST_RESIDUAL = 2.0, 0.2
"""Largest contradiction between the cameras' motions."""


class OneCameraSlam(Protocol):
    """What is used of `Slam`."""

    maps: list[SlamMap]

    def track(self, frame: Frame) -> TrackedFrame:
        """Estimate the pose of the next frame."""

    def trajectory(self) -> Trajectory:
        """Poses in the first map."""


class RigInitialization(NamedTuple):
    """The start of a rig's map."""

    model: SlamMap
    """In meters; its world is the rig at the first localized frame."""
    frames: list[tuple[int, float, Rigid3]]
    """Number, time and rig_from_world of the localized frames; the last one is the present frame."""


class RigStart:
    """Tracks each camera of a rig alone, by a separate SLAM."""

    def __init__(self, rig: CameraRig, make: Callable[[SlamCamera], OneCameraSlam]) -> None:
        self.rig, self._make = rig, make
        self.tracks = Tracks.none()
        self._frames: dict[int, Frame] = {}
        self._numbers: list[int] = []
        self._times: list[float] = []
        self.systems: list[OneCameraSlam] = [make(SlamCamera(camera)) for camera in rig.cameras]
        self._firsts, self._num_lost = [0] * len(rig.cameras), [0] * len(rig.cameras)
        """Of each camera: the frame with which it started, and the frames since it was localized."""

    def add(self, frame: Frame, number: int) -> RigInitialization | str:
        """Track a frame; the start of the map once the motions show its scale, else what is missing."""
        self._numbers.append(number)
        self._times.append(frame.timestamp_s)
        self._frames[number] = frame
        for k, gray in enumerate(self.rig.parts(frame.gray)):
            mask = None if frame.ignored_mask is None else self.rig.parts(frame.ignored_mask)[k].copy()
            self._track(k, Frame(frame.timestamp_s, np.ascontiguousarray(gray), ignored_mask=mask))
        used = {self._number_of(k, one) for k, s in enumerate(self.systems) for one in s.maps[0].keyframes}
        used.update(self._numbers[-KEPT:])
        self._frames = {n: kept for n, kept in self._frames.items() if n in used}
        return self._waiting() if len(self._numbers) % EVERY else self._attempt()

    def _track(self, k: int, frame: Frame) -> None:
        """Track one camera, which starts again if it is lost, or if the scale has not shown for long."""
        system = self.systems[k]
        answer = system.track(frame)
        self._num_lost[k] = 0 if answer.world_from_body is not None else self._num_lost[k] + 1
        is_lost = bool(system.maps[0].num_points) and self._num_lost[k] > PATIENCE
        if is_lost or len(system.maps[0].keyframes) > MOST_KEYFRAMES:
            self.systems[k] = self._make(SlamCamera(self.rig.cameras[k]))
            self._firsts[k], self._num_lost[k] = len(self._numbers), 0

    def _number_of(self, k: int, keyframe: Keyframe) -> int:
        return self._numbers[self._firsts[k] + keyframe.number]

    def _waiting(self) -> str:
        count = sum(bool(system.maps[0].num_points) for system in self.systems)
        if count < 2:
            return f"{TOO_FEW}, and {count} of {len(self.systems)} have moved enough to start alone; two are needed"
        return f"{TOO_FEW}: the scale is unknown until the rig has rotated and moved in several directions"

    def _attempt(self) -> RigInitialization | str:
        """Start with all cameras that see the map now, or with two of them if others contradict."""
        paths = [system.trajectory() for system in self.systems]
        seeing = [k for k, path in enumerate(paths) if len(path) and path.timestamp_s[-1] == self._times[-1]]
        chosen = [tuple(seeing)] if len(seeing) > 2 else []
        reason = ""
        for some in [*chosen, *combinations(seeing, 2)]:
            found = self._start_with(some, [paths[k] for k in some])
            if not isinstance(found, str):
                return found
            reason = reason or found
        return reason or self._waiting()

    def _start_with(self, some: Sequence[int], paths: Sequence[Trajectory]) -> RigInitialization | str:
        times = paths[0].timestamp_s
        for path in paths[1:]:
            times = np.intersect1d(times, path.timestamp_s)
        if len(times) < LEAST_FRAMES:
            return self._waiting()
        mounted, poses = self.rig.cam_from_rig, [_at(path, times) for path in paths]
        rows = list(some)
        found = fit_rig_scales(Rigid3(mounted.rotation[rows], mounted.translation[rows]), poses)
        is_known = (found.sigma <= LARGEST_SIGMA * np.abs(found.scale)).all()
        does_fit = found.residual <= LARGEST_RESIDUAL and (found.scale > 0).all()
        if found.rotation_deg > LARGEST_ROTATION_DEG or (is_known and not does_fit):
            return "the cameras' motions contradict the rig's calibration, or something moves before them"
        return self._joined(rows, found, poses) if is_known else self._waiting()

    def _joined(self, started: list[int], found: RigScales, poses: list[Rigid3]) -> RigInitialization:
        """One map of all started cameras, in the world of the rig at the first common instant."""
        frames: dict[int, tuple[int, float, Rigid3]] = {}
        model = SlamMap()
        for k, scale, path in zip(started, found.scale.tolist(), poses):
            rig_from_cam = self.rig.cam_from_rig[k].inverse()
            grown = Similarity3(np.array(scale), np.eye(3), np.zeros(3))
            first = rig_from_cam @ grown.move_cam_from_source(path[0])
            new_from_old = Similarity3(np.array(1.0), first.rotation, first.translation) @ grown
            alone = self.systems[k].trajectory()
            for time, position in zip(alone.timestamp_s.tolist(), alone.world_from_body.inverse()):
                number = self._numbers[self._times.index(time)]
                moved = rig_from_cam @ new_from_old.move_cam_from_source(position)
                frames.setdefault(number, (number, time, moved))
            own = self.systems[k].maps[0].copied()
            for index in reversed(range(len(own.keyframes))):
                one = own.keyframes[index]
                # Of pure rotation, or too old; and the present frame will become one of the rig.
                number = self._number_of(k, one)
                if not len(one.point) or number not in self._frames or number == self._numbers[-1]:
                    own.remove_keyframe(index)
            own.move(new_from_old)
            self._see_with_rig(own, k)
            model.absorb(own)
        _join_instants(model)
        return RigInitialization(model, [frames[number] for number in sorted(frames)])

    def _see_with_rig(self, model: SlamMap, k: int) -> None:
        """Make a camera's map one of the rig."""
        rig_from_cam, top = self.rig.cam_from_rig[k].inverse(), np.array([0.0, float(self.rig.tops[k])])
        model.anchor_px[:] += top
        for keyframe in model.keyframes:
            keyframe.number = self._number_of(k, keyframe)
            frame = self._frames[keyframe.number]
            keyframe.gray, keyframe.ignored_mask = frame.gray, frame.ignored_mask
            keyframe.cam_from_world = rig_from_cam @ keyframe.cam_from_world
            keyframe.pixels = keyframe.pixels + top
            keyframe.descriptor, keyframe.unit = None, 1.0


def _join_instants(model: SlamMap) -> None:
    """Join keyframes of different cameras that were made from the same frame."""
    for index in reversed(range(1, len(model.keyframes))):
        older, newer = model.keyframes[index - 1], model.keyframes[index]
        if older.number == newer.number:
            older.add(newer.pixels, newer.disparity_px, newer.point)
            model.anchor[model.anchor >= index] -= 1
            model.keyframes.pop(index)


def _at(path: Trajectory, times: np.ndarray) -> Rigid3:
    """cam_from_world at some of a trajectory's times."""
    return path.world_from_body.inverse()[np.searchsorted(path.timestamp_s, times)]
