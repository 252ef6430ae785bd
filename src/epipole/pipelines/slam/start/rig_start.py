"""Start of a map with a rig whose cameras have no common view: each camera alone, until their motions show the scale."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from epipole.geometry import Rigid3, Similarity3
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackedFrame
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap
from epipole.pipelines.slam.start.rig_scale import RigScales, fit_rig_scales
from epipole.pipelines.slam.tracking.points import Tracks
from epipole.scene import CameraRig, Trajectory

LEAST_FRAMES = 15
"""Frames that two cameras must have localized."""
EVERY = 5
"""Frames between two attempts."""
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
        self.rig = rig
        self.systems = [make(SlamCamera(camera)) for camera in rig.cameras]
        self.tracks = Tracks.none()
        self._frames: dict[int, Frame] = {}
        self._numbers: list[int] = []
        self._times: list[float] = []

    def add(self, frame: Frame, number: int) -> RigInitialization | str:
        """Track a frame; the start of the map once the motions show its scale, else what is missing."""
        self._numbers.append(number)
        self._times.append(frame.timestamp_s)
        self._frames[number] = frame
        for k, (system, gray) in enumerate(zip(self.systems, self.rig.parts(frame.gray))):
            mask = None if frame.ignored_mask is None else self.rig.parts(frame.ignored_mask)[k].copy()
            system.track(Frame(frame.timestamp_s, np.ascontiguousarray(gray), ignored_mask=mask))
        self._drop_frames()
        if len(self._numbers) % EVERY:
            return self._waiting()
        return self._attempt()

    def _drop_frames(self) -> None:
        used = {self._number_of(k) for system in self.systems for k in system.maps[0].keyframes}
        used.update(self._numbers[-KEPT:])
        self._frames = {n: frame for n, frame in self._frames.items() if n in used}

    def _number_of(self, keyframe: Keyframe) -> int:
        return self._numbers[keyframe.number]

    def _waiting(self) -> str:
        count = sum(bool(system.maps[0].num_points) for system in self.systems)
        if count < 2:
            return f"{count} of {len(self.systems)} cameras have moved enough to start; two are needed"
        return "the cameras have no common view: the scale is unknown until the rig has rotated and moved in several directions"

    def _attempt(self) -> RigInitialization | str:
        paths = [system.trajectory() for system in self.systems]
        started = [k for k, path in enumerate(paths) if len(path) >= LEAST_FRAMES]
        if len(started) < 2:
            return self._waiting()
        times = paths[started[0]].timestamp_s
        for k in started[1:]:
            times = np.intersect1d(times, paths[k].timestamp_s)
        if len(times) < LEAST_FRAMES:
            return self._waiting()
        poses = [_at(paths[k], times) for k in started]
        rotation, translation = (
            getattr(self.rig.cam_from_rig, n)[started] for n in ("rotation", "translation")
        )
        found = fit_rig_scales(Rigid3(rotation, translation), poses)
        if found.rotation_deg > LARGEST_ROTATION_DEG or found.residual > LARGEST_RESIDUAL:
            return "the cameras' motions contradict the rig's calibration, or something moves before them"
        if not (found.scale > 0).all() or not (found.sigma <= LARGEST_SIGMA * found.scale).all():
            return self._waiting()
        return self._joined(started, found, poses)

    def _joined(self, started: list[int], found: RigScales, poses: list[Rigid3]) -> RigInitialization | str:
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
                if (
                    not len(one.point) or self._number_of(one) not in self._frames
                ):  # of pure rotation, or too old
                    own.remove_keyframe(index)
            own.move(new_from_old)
            self._see_with_rig(own, k)
            model.absorb(own)
        _join_instants(model)
        if self._numbers[-1] not in frames:
            return self._waiting()
        return RigInitialization(model, [frames[number] for number in sorted(frames)])

    def _see_with_rig(self, model: SlamMap, k: int) -> None:
        """Make a camera's map one of the rig."""
        rig_from_cam, top = self.rig.cam_from_rig[k].inverse(), np.array([0.0, float(self.rig.tops[k])])
        model.anchor_px[:] += top
        for keyframe in model.keyframes:
            keyframe.number = self._number_of(keyframe)
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
