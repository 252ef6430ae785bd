"""The path: every frame is told from a keyframe, which goes on to be adjusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from epipole.geometry import Rigid3
from epipole.pipelines.slam.map_covariance import with_map_error
from epipole.pipelines.slam.slam_map import Keyframe
from epipole.scene import Trajectory


@dataclass(slots=True, eq=False)
class _Step:
    timestamp_s: float
    keyframe: Keyframe
    cam_from_keyframe: Rigid3
    unit: float
    """The keyframe's, then."""
    covariance: np.ndarray


class Path:
    """Places of frames."""

    def __init__(self) -> None:
        self._steps: dict[int, _Step] = {}
        self._of_keyframe: dict[int, list[_Step]] = {}

    def add(
        self, number: int, timestamp_s: float, keyframe: Keyframe, place: Rigid3, covariance: np.ndarray
    ) -> None:
        """A frame's cam_from_world, told from a keyframe."""
        relative = place @ keyframe.cam_from_world.inverse()
        step = _Step(timestamp_s, keyframe, relative, keyframe.unit, covariance)
        self._steps[number] = step
        self._of_keyframe.setdefault(id(keyframe), []).append(step)

    def retell(self, gone: Keyframe, heir: Keyframe) -> None:
        """Frames that were told from a keyframe are told from another one from here on."""
        between = gone.cam_from_world @ heir.cam_from_world.inverse()
        for step in self._of_keyframe.pop(id(gone), []):
            if step.keyframe is gone:
                grown = gone.unit / step.unit
                relative = step.cam_from_keyframe
                step.cam_from_keyframe = Rigid3(relative.rotation, relative.translation * grown) @ between
                step.covariance = _scaled(step.covariance[None], np.array([grown]))[0]
                step.keyframe, step.unit = heir, heir.unit
                self._of_keyframe.setdefault(id(heir), []).append(step)

    def forget(self, keyframes: Sequence[Keyframe]) -> None:
        """Frames that are told from these have no place any more."""
        gone = {id(k) for k in keyframes}
        self._steps = {n: s for n, s in self._steps.items() if id(s.keyframe) not in gone}
        self._of_keyframe = {k: steps for k, steps in self._of_keyframe.items() if k not in gone}

    def trajectory(self, keyframes: Sequence[Keyframe]) -> Trajectory:
        """The frames that are told from these keyframes, as they are now."""
        known = {id(k) for k in keyframes}
        steps = [self._steps[n] for n in sorted(self._steps) if id(self._steps[n].keyframe) in known]
        if not steps:
            return Trajectory(np.zeros(0), Rigid3.identity(0), np.zeros((0, 6, 6)))
        keys = [s.keyframe.cam_from_world for s in steps]
        grown = np.array([s.keyframe.unit / s.unit for s in steps])
        relative = Rigid3(
            np.stack([s.cam_from_keyframe.rotation for s in steps]),
            np.stack([s.cam_from_keyframe.translation for s in steps]) * grown[:, None],
        )
        there = Rigid3(np.stack([k.rotation for k in keys]), np.stack([k.translation for k in keys]))
        own = _scaled(np.stack([s.covariance for s in steps]), grown)
        of_map = np.stack([s.keyframe.covariance for s in steps])
        times = np.array([s.timestamp_s for s in steps])
        return Trajectory(times, (relative @ there).inverse(), with_map_error(of_map, relative, own))


def _scaled(covariance: np.ndarray, grown: np.ndarray) -> np.ndarray:
    """(n, 6, 6) of places whose unit has changed."""
    unit = np.repeat(np.stack([grown, np.ones(len(grown))], axis=1), 3, axis=1)
    return covariance * unit[:, :, None] * unit[:, None, :]
