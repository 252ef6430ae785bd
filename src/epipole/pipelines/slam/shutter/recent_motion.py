"""Current motion of a rolling shutter camera from several frames, since the motion from a single frame could bend the map."""

from __future__ import annotations

import numpy as np

from epipole.geometry import Rigid3

LONGEST_STEP_S = 0.5
"""Longest time between two frames for estimating the motion."""
FASTEST = 10.0
"""Scene depths or radians per second; anything faster is a jump of the map."""
AROUND = 5
"""Frames, including itself, that determine a frame's motion; three are too few for a shaking hand."""
BEFORE = 3
"""Frames, including itself, that determine the motion of the last frame; more amplify their errors."""
NO_MOTION = np.zeros(12)


class RecentMotion:
    """Relative poses of the last frames.

    Attributes:
        times: timestamps of the frames, in seconds.
        steps: transforms from each camera to the next, one fewer.
        has_dropped: whether earlier frames were dropped.
    """

    def __init__(self) -> None:
        self.times: list[float] = []
        self.steps: list[Rigid3] = []
        self.has_dropped = False

    def start_at(self, timestamp_s: float) -> RecentMotion:
        """This object if the last frame has this timestamp; else a new one that starts with it."""
        if self.times and self.times[-1] == timestamp_s:
            return self
        out = RecentMotion()
        out.times = [timestamp_s]
        return out

    def with_step(self, timestamp_s: float, step: Rigid3, depth: float) -> RecentMotion:
        """A copy with one more step; empty if the step is too long, or too fast for a scene at this depth."""
        out, seconds = RecentMotion(), timestamp_s - self.times[-1] if self.times else np.inf
        speed = np.abs(step.log() / np.repeat([depth, 1.0], 3)).max() / max(seconds, 1e-9)
        if seconds <= LONGEST_STEP_S and speed <= FASTEST:
            out.has_dropped = self.has_dropped or len(self.times) == AROUND
            out.times, out.steps = [*self.times, timestamp_s][-AROUND:], [*self.steps, step][1 - AROUND :]
        return out

    def grow(self, factor: float) -> None:
        """Multiply lengths by a factor."""
        self.steps = [Rigid3(step.rotation, step.translation * factor) for step in self.steps]

    def motion(self, frame: int, first: int = 0) -> np.ndarray:
        """(12,) motion of a frame, from the frames from `first` on; zero if there is only one."""
        if len(self.times) - first < 2:
            return NO_MOTION
        cams = [Rigid3.identity()]
        for step in self.steps[first:]:
            cams.append(step @ cams[-1])
        there = Rigid3(np.stack([c.rotation for c in cams]), np.stack([c.translation for c in cams]))
        return motion_among(np.array(self.times[first:]), there, frame - first)

    def newest(self) -> np.ndarray:
        """(12,) motion of the last frame."""
        return self.motion(len(self.times) - 1, max(len(self.times) - BEFORE, 0))

    def final_motions(self) -> dict[float, np.ndarray]:
        """Final motions (12,) by timestamp: of the middle frame, or of all frames while none was dropped."""
        frames = [AROUND // 2] if self.has_dropped else range(len(self.times))
        return {self.times[frame]: self.motion(frame) for frame in frames}


def motion_among(times: np.ndarray, cams_from_world: Rigid3, frame: int) -> np.ndarray:
    """(12,) velocity and acceleration of a frame's camera: cam(t + dt) = exp(dt xi + dt^2 / 2 xi') cam(t).

    They are the coefficients of the polynomial through the poses of all frames, in the tangent space at this frame.

    Args:
        times: (m,) timestamps of the frames, with m from 2 to 5.
        cams_from_world: (m,) their poses.
        frame: index of the frame.
    """
    there = cams_from_world[frame].inverse()
    others = np.flatnonzero(np.arange(len(times)) != frame)
    dt = times[others] - times[frame]
    moved = (cams_from_world[others] @ there).log()
    powers = np.arange(1, len(others) + 1)
    taylor = np.linalg.solve(dt[:, None] ** powers / np.cumprod(powers), moved)
    return np.concatenate([taylor[0], taylor[1] if len(taylor) > 1 else np.zeros(6)])
