"""A known path whose rows are told by the numbers of images, not by times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from epipole.scene import Trajectory

MOST_NAMED = 0.9
"""Share of the images with times whose numbers the truth's first column holds, where it is no time."""


def at_image_numbers(
    truth: Trajectory,
    images: Sequence[str],
    timestamp_s: Float64[np.ndarray, " n"],
    max_difference_s: float,
) -> Trajectory | None:
    """The truth with the images' times, where its own are the last numbers in the images' names (7-Scenes).

    Args:
        truth: what a file's first column calls times may be numbers.
        images: file names.
        timestamp_s: of each; NaN where it has no time.
        max_difference_s: instants nearer than that to most images' are times indeed.

    Returns:
        None where its times are times.
    """
    given = truth.timestamp_s
    num_timed = int(np.isfinite(timestamp_s).sum())
    if not len(given) or not num_timed:
        return None
    numbers = [re.findall(r"\d+", Path(name).stem) for name in images]
    named = np.array([float(found[-1]) if found else np.nan for found in numbers])
    row = np.searchsorted(given, named).clip(0, len(given) - 1)
    meets = (given[row] == named) & np.isfinite(timestamp_s)
    after = np.searchsorted(given, timestamp_s)
    sides = np.stack([given[(after - side).clip(0, len(given) - 1)] for side in (0, 1)])
    near = np.abs(sides - timestamp_s).min(axis=0) <= max_difference_s
    are_whole = bool((given == np.rint(given)).all())
    if not are_whole or 2 * near.sum() >= num_timed or meets.sum() < MOST_NAMED * num_timed:
        return None
    return Trajectory(timestamp_s[meets], truth.world_from_body[row[meets]])
