"""How a camera with a rolling shutter moves at present, by the frames around: what a single frame tells of it may bend the map."""

from __future__ import annotations

import numpy as np

from epipole.geometry import Rigid3

LONGEST_STEP_S = 0.5
"""Between two frames of which the motion is told."""
FASTEST = 10.0
"""Depths of the scene, or radians, per second: faster is a jump of the map."""
AROUND = 5
"""Frames, with itself, by which a frame's motion is told: a hand shakes, and three are too few for that."""
BEFORE = 3
"""Frames, with itself, of which that of the last one is told: more make more of their errors."""
NO_MOTION = np.zeros(12)


class RecentMotion:
    """The camera's steps from frame to frame, as many as tell its motion.

    Attributes:
        times: of the frames, seconds.
        steps: from each camera to the next, one fewer.
        has_dropped: earlier ones were forgotten.
    """

    def __init__(self) -> None:
        self.times: list[float] = []
        self.steps: list[Rigid3] = []
        self.has_dropped = False

    def start_at(self, timestamp_s: float) -> RecentMotion:
        """The same where this was the last frame; else one that begins with it."""
        if self.times and self.times[-1] == timestamp_s:
            return self
        out = RecentMotion()
        out.times = [timestamp_s]
        return out

    def with_step(self, timestamp_s: float, step: Rigid3, depth: float) -> RecentMotion:
        """The same and one more step; none at all where it is long, or too fast for a scene at that depth."""
        out, seconds = RecentMotion(), timestamp_s - self.times[-1] if self.times else np.inf
        speed = np.abs(step.log() / np.repeat([depth, 1.0], 3)).max() / max(seconds, 1e-9)
        if seconds <= LONGEST_STEP_S and speed <= FASTEST:
            out.has_dropped = self.has_dropped or len(self.times) == AROUND
            out.times, out.steps = [*self.times, timestamp_s][-AROUND:], [*self.steps, step][1 - AROUND :]
        return out

    def grow(self, factor: float) -> None:
        """Tell lengths in another unit."""
        self.steps = [Rigid3(step.rotation, step.translation * factor) for step in self.steps]

    def motion(self, frame: int, first: int = 0) -> np.ndarray:
        """(12,) of one of the frames, by those from the first one on; zero if it is alone."""
        if len(self.times) - first < 2:
            return NO_MOTION
        cams = [Rigid3.identity()]
        for step in self.steps[first:]:
            cams.append(step @ cams[-1])
        there = Rigid3(np.stack([c.rotation for c in cams]), np.stack([c.translation for c in cams]))
        return motion_among(np.array(self.times[first:]), there, frame - first)

    def newest(self) -> np.ndarray:
        """(12,) of the last frame."""
        return self.motion(len(self.times) - 1, max(len(self.times) - BEFORE, 0))

    def converged(self) -> dict[float, np.ndarray]:
        """Motions (12,) of frames of which as much is known as ever will be, by their times; at first of all frames."""
        frames = [AROUND // 2] if self.has_dropped else range(len(self.times))
        return {self.times[frame]: self.motion(frame) for frame in frames}


def motion_among(times: np.ndarray, cams_from_world: Rigid3, frame: int) -> np.ndarray:
    """(12,) speed of a frame's camera per second, and its change: cam(t + dt) = exp(dt xi + dt^2 / 2 xi') cam(t).

    Of the polynomial through the places of all frames in the tangent space at this one.

    Args:
        times: (m,) of the frames, at least two; those of a small readout, m no more than 5.
        cams_from_world: (m,) their places.
        frame: which of them.
    """
    there = cams_from_world[frame].inverse()
    others = np.flatnonzero(np.arange(len(times)) != frame)
    dt = times[others] - times[frame]
    moved = (cams_from_world[others] @ there).log()
    powers = np.arange(1, len(others) + 1)
    taylor = np.linalg.solve(dt[:, None] ** powers / np.cumprod(powers), moved)
    return np.concatenate([taylor[0], taylor[1] if len(taylor) > 1 else np.zeros(6)])
