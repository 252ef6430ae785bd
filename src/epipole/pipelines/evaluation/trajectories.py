"""A trajectory against a known one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from epipole._checks import as_path
from epipole._declared import checked
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
"""Of an output folder: the final one, and what was known when each frame came."""
STARTED = "checkpoint/trajectory_causal.txt"
"""Of one that was stopped."""


def trajectories_of(out: Path, truth: Path) -> list[Path]:
    """The trajectories to compare with a truth; empty where the truth is one of images.

    Raises:
        FileFormatError: the truth is a trajectory, and there is none to compare with it.
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
            f"; the run in it was stopped: {STARTED} is the path so far, and --resume goes on"
            if started.is_file()
            else ""
        )
        raise FileFormatError(out, f"is no trajectory, and holds no {TRAJECTORIES[0]}{stopped}")
    return found


@checked
def evaluate_trajectory(
    estimate: str | Path, truth: str | Path, max_difference_s: float = 0.01
) -> TrajectoryEvaluation:
    """Compare a trajectory with a known one.

    Instants without times (KITTI) belong together in their order; beside the other's table of frames in theirs. A truth
    whose times are numbers of images (7-Scenes) is known by the names in that table. Where the order of a quaternion or
    the unit of times cannot be known from one file, both files decide together, and `assumptions` says how they were read.

    Args:
        estimate: TUM, KITTI or EuRoC file.
        truth: another, or a folder of frames that brings one (7-Scenes, ScanNet, TUM RGB-D, KITTI, EuRoC).
        max_difference_s: instants further apart are not compared.

    Raises:
        FileFormatError: one of them cannot be read, its columns can be meant in several ways and both files together do not
            decide, or one has times, the other none, and they differ in length.
        DegenerateGeometryError: too few instants belong together, or the path is a line.
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
    """A truth whose times are numbers of images, with the images' times."""
    timed = at_image_numbers(known.trajectory, table.image, table.timestamp_s, max_difference_s)
    return None if timed is None else Reading(timed, known.assumptions)


def _timed_together(
    estimate: Path, truth: Path, found: Reading, known: Reading, table: FrameTable | None
) -> Reading:
    """The known path, with the times of the other trajectory's frames where these are known.

    Raises:
        FileFormatError: which rows belong together is unknown.
    """
    ours, theirs = found.trajectory, known.trajectory
    if ours.is_timed and table is not None and len(table.image) == len(theirs):
        rows = np.flatnonzero(np.isfinite(table.timestamp_s))
        return Reading(Trajectory(table.timestamp_s[rows], theirs.world_from_body[rows]), known.assumptions)
    if len(ours) == len(theirs):
        return known  # in their order
    without, count = (estimate, len(theirs)) if theirs.is_timed else (truth, len(ours))
    raise FileFormatError(
        without,
        f"holds no times (KITTI's form), and the other trajectory has {count} instants: which of its rows"
        " are theirs cannot be told",
    )


def _table_beside(estimate: Path) -> FrameTable | None:
    """Of all frames that a trajectory of `epipole slam` was made from, those without a place too; None for another."""
    table = estimate.with_name(FRAME_TABLE)
    return read_frame_table(table) if table.is_file() else None
