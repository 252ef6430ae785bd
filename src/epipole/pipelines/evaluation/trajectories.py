"""Evaluation of a trajectory against ground truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from epipole._checks import as_path, checked
from epipole.errors import FileFormatError
from epipole.io.trajectories.frame_tables import FRAME_TABLE, FrameTable, read_frame_table
from epipole.io.trajectories.true_trajectories import has_true_path, true_path_at
from epipole.io.truth import is_truth_of_images
from epipole.metrics import TrajectoryEvaluation as TrajectoryEvaluation
from epipole.metrics import score_trajectory
from epipole.metrics.numbered_truth import at_image_numbers
from epipole.pipelines.evaluation.readings import Reading, decide_order, decide_units, read_file
from epipole.scene import Trajectory

TRAJECTORIES = ("trajectory.txt", "trajectory_causal.txt")
"""Trajectories in an output folder: the final one, and the causal one, known at the time of each frame."""
STARTED = "checkpoint/trajectory_causal.txt"
"""Trajectory in the output folder of a stopped run."""


def trajectories_of(out: Path, truth: Path) -> list[Path]:
    """The trajectories to compare with the ground truth; empty if that consists of images.

    Raises:
        FileFormatError: the ground truth is a trajectory, and there is none to compare with it.
    """
    found = [out] if out.is_file() else [out / name for name in TRAJECTORIES if (out / name).is_file()]
    if truth.is_dir():
        if is_truth_of_images(truth) or not (found or has_true_path(truth)):
            return []
    elif not truth.is_file() or truth.suffix.lower() == ".json" or truth.name.endswith("_par.txt"):
        return []
    if not found:
        started = out / STARTED
        stopped = (
            f"; its run was stopped: {STARTED} is the trajectory so far, and --resume continues the run"
            if started.is_file()
            else ""
        )
        raise FileFormatError(out, f"not a trajectory, nor a folder with {TRAJECTORIES[0]}{stopped}")
    return found


@checked
def evaluate_trajectory(
    estimate: str | Path, truth: str | Path, max_difference_s: float = 0.01
) -> TrajectoryEvaluation:
    """Compare a trajectory with ground truth.

    Trajectories without times (KITTI) are matched in order, or in the order of the other's frame table. Ground truth
    whose times are image numbers (7-Scenes) is recognized by the names in that table. If one file alone does not
    determine the quaternion order or the time unit, both files are used, and `assumptions` reports how they were
    interpreted.

    Args:
        estimate: TUM, KITTI or EuRoC file.
        truth: another one, or a dataset folder that includes one (7-Scenes, ScanNet, TUM RGB-D, KITTI, EuRoC).
        max_difference_s: largest time difference between compared poses.

    Raises:
        FileFormatError: a file is unreadable, its columns are ambiguous even with both files, or only one has times and
            they differ in length.
        DegenerateGeometryError: too few poses match, or the trajectory is a straight line.
    """
    estimate, truth = as_path(estimate), as_path(truth)
    table = _table_beside(estimate)
    found = read_file(estimate)
    if truth.is_dir():
        brought = true_path_at(truth)
        known = Reading(brought.trajectory, brought.assumptions)
    else:
        known = read_file(truth, is_of_camera=table is not None)
    is_timed, is_truth_timed = found.trajectory.is_timed, known.trajectory.is_timed
    if is_timed and is_truth_timed:
        numbered = None if table is None else _numbered(known, table, max_difference_s)
        known = known if numbered is None else numbered
        found, known = decide_units(found, known, max_difference_s)
    elif is_timed != is_truth_timed:
        known = _timed_together(estimate, truth, found, known, table)
    found, known = decide_order(found, known, max_difference_s)
    score = score_trajectory(found.trajectory, known.trajectory, max_difference_s)
    return replace(score, assumptions=tuple(dict.fromkeys([*found.assumptions, *known.assumptions])))


def _numbered(known: Reading, table: FrameTable, max_difference_s: float) -> Reading | None:
    """Ground truth whose times are image numbers, with the images' times."""
    timed = at_image_numbers(known.trajectory, table.image, table.timestamp_s, max_difference_s)
    return None if timed is None else Reading(timed, known.assumptions)


def _timed_together(
    estimate: Path, truth: Path, found: Reading, known: Reading, table: FrameTable | None
) -> Reading:
    """The ground truth, with the times of the other trajectory's frames if these are known.

    Raises:
        FileFormatError: it is unknown which rows match.
    """
    ours, theirs = found.trajectory, known.trajectory
    if ours.is_timed and table is not None and len(table.image) == len(theirs):
        rows = np.flatnonzero(np.isfinite(table.timestamp_s))
        return Reading(Trajectory(table.timestamp_s[rows], theirs.world_from_body[rows]), known.assumptions)
    if len(ours) == len(theirs):
        return known  # matched in order
    without, rows_without, count = (
        (estimate, len(ours), len(theirs)) if theirs.is_timed else (truth, len(theirs), len(ours))
    )
    raise FileFormatError(
        without,
        f"its {rows_without} rows have no timestamps (KITTI format), so they cannot be matched with the {count} poses of"
        " the other trajectory: use a file with one row per pose, or one in TUM format",
    )


def _table_beside(estimate: Path) -> FrameTable | None:
    """The table of all frames beside a trajectory of `epipole slam`, including frames without a pose; None if missing."""
    table = estimate.with_name(FRAME_TABLE)
    return read_frame_table(table) if table.is_file() else None
