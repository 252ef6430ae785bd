"""Ground truth whose rows are identified by image numbers instead of times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from epipole.scene import Trajectory

MOST_NAMED = 0.9
"""Minimum fraction of timed images whose number is in the truth's first column, if that is not a time."""


def at_image_numbers(
    truth: Trajectory,
    images: Sequence[str],
    timestamp_s: Float64[np.ndarray, " n"],
    max_difference_s: float,
) -> Trajectory | None:
    """The truth with the images' times, if its own "times" are the last numbers in the image names (7-Scenes).

    Args:
        truth: a trajectory whose times may be image numbers.
        images: file names.
        timestamp_s: time of each image; NaN if unknown.
        max_difference_s: if most images have a time of the truth within this, its times are real.

    Returns:
        None if the truth's times are real.
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
