"""A trajectory against a known one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epipole._checks import as_path
from epipole._declared import checked
from epipole.errors import FileFormatError
from epipole.io.frame_tables import FRAME_TABLE, FrameTable, read_frame_table
from epipole.io.trajectories import read_trajectory, trajectory_format
from epipole.metrics import TrajectoryEvaluation as TrajectoryEvaluation
from epipole.metrics import score_trajectory
from epipole.metrics.numbered_truth import at_numbers_of_pictures
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
    if not truth.is_file() or truth.suffix.lower() == ".json" or truth.name.endswith("_par.txt"):
        return []
    if out.is_file():
        return [out]
    found = [out / name for name in TRAJECTORIES if (out / name).is_file()]
    if not found:
        begun = out / BEGUN
        stopped = (
            f"; the run in it was stopped: {BEGUN} is the path so far, and --resume goes on"
            if begun.is_file()
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
    whose times are numbers of pictures (7-Scenes) is known by the names in that table.

    Args:
        estimate: TUM, KITTI or EuRoC file.
        truth: another.
        max_difference_s: instants further apart are not compared.

    Raises:
        FileFormatError: one of them cannot be read, or one has times, the other none, and they differ in length.
        DegenerateGeometryError: too few instants belong together, or the path is a line.
    """
    estimate, truth = as_path(estimate), as_path(truth)
    found, known = read_trajectory(estimate), read_trajectory(truth)
    is_timed, is_truth_timed = (trajectory_format(path) != "kitti" for path in (estimate, truth))
    table = _table_beside(estimate)
    if is_timed and is_truth_timed and table is not None:
        numbered = at_numbers_of_pictures(known, table.picture, table.timestamp_s, max_difference_s)
        known = known if numbered is None else numbered
    if is_timed != is_truth_timed:
        if is_timed and table is not None and len(table.picture) == len(known):
            told = np.flatnonzero(np.isfinite(table.timestamp_s))
            known = Trajectory(table.timestamp_s[told], known.world_from_body[told])
        elif len(found) == len(known):
            known = Trajectory(found.timestamp_s, known.world_from_body)
        else:
            without, others = (estimate, len(known)) if is_truth_timed else (truth, len(found))
            raise FileFormatError(
                without,
                f"holds no times (KITTI's form), and the other trajectory has {others} instants: which of its rows"
                " are theirs cannot be told",
            )
    return score_trajectory(found, known, max_difference_s)


def _table_beside(estimate: Path) -> FrameTable | None:
    """Of all frames that a trajectory of `epipole slam` was made from, those without a place too; None for another."""
    table = estimate.with_name(FRAME_TABLE)
    return read_frame_table(table) if table.is_file() else None
