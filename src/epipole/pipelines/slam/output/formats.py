"""Paths in KITTI's or EuRoC's form, beside TUM's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from epipole.io.trajectories.files import TrajectoryFormat, write_trajectory
from epipole.scene import Trajectory

_SUFFIXES = {"kitti": "_kitti.txt", "euroc": "_euroc.csv"}


def write_in_format(
    paths: Sequence[Trajectory], names: Sequence[str], format: TrajectoryFormat, folder: Path
) -> None:
    """Write paths in another form than TUM's: trajectory_kitti.txt, trajectory_euroc.csv.

    Args:
        paths: the paths.
        names: of TUM's files of them.
        format: nothing is written for TUM.
        folder: where to.

    Raises:
        WorkspaceError: a file cannot be written.
    """
    for path, name in zip(paths, names):
        if format != "tum" and len(path):
            write_trajectory(path, folder / f"{Path(name).stem}{_SUFFIXES[format]}", format)


def missing_rows(path: Trajectory, num_frames: int, format: TrajectoryFormat) -> list[str]:
    """A warning where KITTI's form, which counts frames by lines, lacks some."""
    if format != "kitti" or len(path) == num_frames:
        return []
    return [
        f"KITTI's form tells no times, and {num_frames - len(path)} frames have no place: its lines are not frames"
    ]
