"""Detection of a rolling shutter from a finished map, and estimation of its readout time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from epipole.pipelines.slam.map.local_mapping import LocalMapper
from epipole.pipelines.slam.shutter.motion import motions_at, shutter_shifts
from epipole.pipelines.slam.shutter.shutter import Shutter
from epipole.scene import Trajectory

LEAST_KEYFRAMES, MOST_KEYFRAMES = 10, 60
TRIED = (0.5, 0.25, 0.75, 1.0)
"""Readout times that are tried, as fractions of the frame interval."""
NEAR = 0.1
"""Distance from the best to two further readout times that are tried, as a fraction of the frame interval."""
LEAST_GAIN = 0.1
"""Fraction by which the cost must fall for a readout to be accepted."""


@dataclass(frozen=True, slots=True)
class ReadoutFound:
    """A detected rolling shutter."""

    readout_s: float
    """From the first row to the one after the last."""
    gain: float
    """Fraction of the cost that modeling the readout removes."""

    def warning(self) -> str:
        """Warning for the user."""
        return (
            f"the images have a rolling shutter with a readout of {1e3 * self.readout_s:.1f} ms, which bends the trajectory:"
            f" run again with --readout-s {self.readout_s:.4f}"
        )


@contextmanager
def with_readout(mapper: LocalMapper, path: Trajectory, readout_s: float) -> Iterator[None]:
    """Inside the block, shift the keyframes' observations to those of a global shutter.

    Args:
        mapper: mapper of the map.
        path: trajectory of all its frames.
        readout_s: from the first row to the one after the last; 0 changes nothing.
    """
    keyframes = [keyframe for keyframe in mapper.map.keyframes if len(keyframe.point)]
    kept = [keyframe.shift_px for keyframe in keyframes]
    try:
        if (shutter := Shutter(mapper.sensor.camera, readout_s)).is_rolling:
            for keyframe, motion in zip(keyframes, motions_at(path, keyframes)):
                keyframe.shift_px = shutter_shifts(mapper.map, keyframe, motion, shutter)
        yield
    finally:
        for keyframe, shift in zip(keyframes, kept):
            keyframe.shift_px = shift


def find_readout(mapper: LocalMapper, path: Trajectory) -> ReadoutFound | None:
    """The readout time that fits the keyframes best; None for a global shutter or too little motion.

    A rolling shutter leaves residuals that depend on the row and the motion. For each readout time, the pixels are corrected
    by the motion between the frames around each keyframe and the map is adjusted; the result is the minimum of a parabola
    through the costs.

    Args:
        mapper: mapper of the map, which is not changed.
        path: trajectory of all its frames.
    """
    keyframes = [k for k in mapper.map.keyframes if len(k.point)][:MOST_KEYFRAMES]
    if len(keyframes) < LEAST_KEYFRAMES or len(path) < LEAST_KEYFRAMES:
        return None
    numbers = [n for n, k in enumerate(mapper.map.keyframes) if any(k is own for own in keyframes)]
    interval = float(np.median(np.diff(path.timestamp_s)))
    motions = motions_at(path, keyframes)
    kept = [k.shift_px for k in keyframes]

    def cost(fraction: float) -> float:
        shutter = Shutter(mapper.sensor.camera, fraction * interval)
        for keyframe, motion in zip(keyframes, motions):
            keyframe.shift_px = shutter_shifts(mapper.map, keyframe, motion, shutter)
        return mapper.cost_of(numbers)

    try:
        costs = {0.0: cost(0.0)}
        for fraction in TRIED:
            costs[fraction] = cost(fraction)
            if costs[0.5] >= costs[0.0]:
                return None
        if 1.0 - min(costs.values()) / costs[0.0] < LEAST_GAIN:
            return None
        best = _lowest(costs)
        near = {fraction: cost(fraction) for fraction in (best - NEAR, best, best + NEAR)}
    finally:
        for keyframe, shift in zip(keyframes, kept):
            keyframe.shift_px = shift
    return ReadoutFound(_lowest(near) * interval, 1.0 - min(near.values()) / costs[0.0])


def _lowest(costs: dict[float, float]) -> float:
    """Minimum of a parabola through the lowest cost and its neighbors."""
    fractions = np.array(sorted(costs))
    values = np.array([costs[fraction] for fraction in fractions])
    middle = int(np.clip(np.argmin(values), 1, len(fractions) - 2))
    a, b, _ = np.polyfit(fractions[middle - 1 : middle + 2], values[middle - 1 : middle + 2], 2)
    lowest = -b / (2.0 * a) if a > 0 else fractions[int(np.argmin(values))]
    return float(np.clip(lowest, NEAR, 1.2))
