"""A trajectory against a known one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from epipole._checks import as_path
from epipole.errors import FileFormatError
from epipole.io.frame_tables import FRAME_TABLE, FrameTable, read_frame_table
from epipole.io.true_paths import has_true_path, true_path_at
from epipole.io.truth import is_truth_of_images
from epipole.metrics import TrajectoryEvaluation as TrajectoryEvaluation
from epipole.metrics import score_trajectory
from epipole.metrics.numbered_truth import at_numbers_of_pictures
from epipole.pipelines.evaluation.readings import Readings, decide_order, decide_units
from epipole.scene import Trajectory

TRAJECTORIES = ("trajectory.txt", "trajectory_causal.txt")
"""Of an output folder: the final one, and what was known when each frame came."""
BEGUN = "checkpoint/trajectory_causal.txt"
"""Of one that was stopped."""


def trajectories_of(out: Path, truth: Path) -> list[Path]:
    """The trajectories to compare with a truth; empty where the truth is one of pictures.

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
        begun = out / BEGUN
        stopped = (
            f"; the run in it was stopped: {BEGUN} is the path so far, and --resume goes on"
            if begun.is_file()
            else ""
        )
        raise FileFormatError(out, f"is no trajectory, and holds no {TRAJECTORIES[0]}{stopped}")
    return found


def evaluate_trajectory(
    estimate: str | Path, truth: str | Path, max_difference_s: float = 0.01
) -> TrajectoryEvaluation:
    """Compare a trajectory with a known one.

    Instants without times (KITTI) belong together in their order; beside the other's table of frames in theirs. A truth
    whose times are numbers of pictures (7-Scenes) is known by the names in that table. Where the order of a quaternion or
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
    readings = Readings.of(estimate)
    if truth.is_dir():
        brought = true_path_at(truth)
        others = Readings.of_path(brought.trajectory, brought.assumptions)
    else:
        others = Readings.of(truth, is_of_camera=table is not None)
    said: list[str] = []
    if readings.is_timed and others.is_timed:
        known = _numbered(others.usual, table, max_difference_s)
        if known is not None:
            others = Readings.of_path(known, others.assumptions)
        said += decide_units(readings, others, max_difference_s)
    elif readings.is_timed != others.is_timed:
        others = _timed_together(estimate, truth, readings, others, table)
    said += decide_order(readings, others, max_difference_s)
    found = score_trajectory(readings.usual, others.usual, max_difference_s)
    return replace(
        found, assumptions=tuple(dict.fromkeys([*readings.assumptions, *others.assumptions, *said]))
    )


def _numbered(known: Trajectory, table: FrameTable | None, max_difference_s: float) -> Trajectory | None:
    if table is None:
        return None
    return at_numbers_of_pictures(known, table.picture, table.timestamp_s, max_difference_s)


def _timed_together(
    estimate: Path, truth: Path, readings: Readings, others: Readings, table: FrameTable | None
) -> Readings:
    """The known path, with the times of the other trajectory's rows or frames.

    Raises:
        FileFormatError: which rows belong together is unknown.
    """
    found, known = readings.usual, others.usual
    if readings.is_timed and table is not None and len(table.picture) == len(known):
        rows = np.flatnonzero(np.isfinite(table.timestamp_s))
        return Readings.of_path(
            Trajectory(table.timestamp_s[rows], known.world_from_body[rows]), others.assumptions
        )
    if len(found) == len(known):
        return others
    without, count = (estimate, len(known)) if others.is_timed else (truth, len(found))
    raise FileFormatError(
        without,
        f"holds no times (KITTI's form), and the other trajectory has {count} instants: which of its rows"
        " are theirs cannot be told",
    )


def _table_beside(estimate: Path) -> FrameTable | None:
    """Of all frames that a trajectory of `epipole slam` was made from, those without a place too; None for another."""
    table = estimate.with_name(FRAME_TABLE)
    return read_frame_table(table) if table.is_file() else None
