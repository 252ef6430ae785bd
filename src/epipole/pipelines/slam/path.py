"""The path: every frame is told from a keyframe, which goes on to be adjusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from epipole.geometry import Rigid3
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

    def add(
        self, number: int, timestamp_s: float, keyframe: Keyframe, place: Rigid3, covariance: np.ndarray
    ) -> None:
        """A frame's cam_from_world, told from a keyframe."""
        relative = place @ keyframe.cam_from_world.inverse()
        self._steps[number] = _Step(timestamp_s, keyframe, relative, keyframe.unit, covariance)

    def forget(self, keyframes: Sequence[Keyframe]) -> None:
        """Frames that are told from these have no place any more."""
        gone = {id(k) for k in keyframes}
        self._steps = {n: s for n, s in self._steps.items() if id(s.keyframe) not in gone}

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
        unit = np.stack([*3 * [grown], *3 * [np.ones(len(steps))]], axis=1)
        return Trajectory(
            np.array([s.timestamp_s for s in steps]),
            (relative @ there).inverse(),
            np.stack([s.covariance for s in steps]) * unit[:, :, None] * unit[:, None, :],
        )
