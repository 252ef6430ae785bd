"""Comparison of trajectories with the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.geometry import Similarity3
from epipole.io.trajectories.true_trajectories import Truth
from epipole.io.trajectories.true_trajectories import true_path_at as true_path_at
from epipole.metrics import absolute_error, associate, score_trajectory
from epipole.metrics.numbered_truth import at_image_numbers
from epipole.pipelines.slam.output.record import FrameRecord
from epipole.scene import Trajectory

MAX_DIFFERENCE_S = 0.01
"""Largest time difference between a frame and its true pose."""
LEAST_COVERAGE = 0.2
"""Smallest fraction of the frames, or of the truth if it has fewer rows, that must be compared to report errors."""


def truth_at_frames(truth: Truth, records: Sequence[FrameRecord]) -> Trajectory:
    """The truth, with the timestamps of the frames if it has none (one row for each frame of the source).

    Raises:
        ConfigError: the numbers of rows and frames differ, and the image names are not row numbers.
    """
    if truth.has_times:
        times = np.array([r.answer.timestamp_s if r.answer else np.nan for r in records])
        names = [record.name for record in records]
        return at_image_numbers(truth.trajectory, names, times, MAX_DIFFERENCE_S) or truth.trajectory
    rows = np.array([record.number for record in records])
    if len(truth.trajectory) != len(records):
        stems = [Path(record.name).stem for record in records]
        rows = np.array([int(stem) if stem.isdecimal() else -1 for stem in stems])
        if not len(rows) or rows.min() < 0 or rows.max() >= len(truth.trajectory):
            raise ConfigError(
                f"the truth has no timestamps (KITTI format) and {len(truth.trajectory)} rows for"
                f" {len(records)} frames: rows and frames cannot be matched"
            )
    given = [(row, record.answer.timestamp_s) for row, record in zip(rows, records) if record.answer]
    positions = truth.trajectory.world_from_body[np.array([row for row, _ in given], np.int64)]
    return Trajectory(np.array([time for _, time in given], np.float64), positions)


@dataclass(frozen=True, slots=True, eq=False)
class PathErrors:
    """Distances of a trajectory from the truth at each timestamp."""

    timestamp_s: np.ndarray
    distance: np.ndarray
    """In the truth's unit, after the alignment."""
    estimate_from_truth: Similarity3
    """Transforms the truth into the trajectory's world, by the same alignment."""


def errors_of(estimate: Trajectory, truth: Trajectory, *, with_scale: bool) -> PathErrors | None:
    """Errors after alignment, with scale for a trajectory of unknown scale; None if they cannot be computed."""
    try:
        rows, rows_of_truth = associate(estimate, truth, MAX_DIFFERENCE_S)
        ours, theirs = estimate.world_from_body[rows], truth.world_from_body[rows_of_truth]
        found = absolute_error(ours, theirs, "similarity" if with_scale else "rigid")
    except DegenerateGeometryError:
        return None
    return PathErrors(estimate.timestamp_s[rows], found.position.values, found.truth_from_estimate.inverse())


def truth_summary(
    truth: Truth, known: Trajectory, paths: tuple[Trajectory, Trajectory], num_frames: int
) -> tuple[dict[str, Any], list[str]]:
    """Errors for the summary, and warnings.

    Args:
        truth: the truth as read.
        known: the truth at the timestamps of the frames.
        paths: final and causal trajectory.
        num_frames: frames of the source.
    """
    out: dict[str, Any] = {
        "source": str(truth.path),
        "max_difference_s": MAX_DIFFERENCE_S,
        "read_as": list(truth.assumptions),
    }
    warnings = []
    for name, path in zip(("final", "causal"), paths):
        try:
            found = score_trajectory(path, known, MAX_DIFFERENCE_S)
            if found.num_compared < LEAST_COVERAGE * min(found.num_instants, found.num_truth):
                raise DegenerateGeometryError(
                    f"{found.num_compared} of {found.num_instants} poses have a true pose within {MAX_DIFFERENCE_S:g} s;"
                    " check that both use the same clock and unit"
                )
        except DegenerateGeometryError as error:
            out[name] = None
            warnings.append(f"the {name} trajectory is not compared with the truth: {error}")
            continue
        out[name] = {**asdict(found), "coverage": found.num_compared / num_frames}
        if name == "final" and 2 * found.num_compared < min(found.num_instants, found.num_truth):
            warnings.append(
                f"{found.num_compared} of {found.num_instants} poses have a true pose within"
                f" {MAX_DIFFERENCE_S:g} s; check that both use the same clock and unit"
            )
    return out, warnings
