"""Trajectories in KITTI or EuRoC format, in addition to TUM."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from epipole.io.trajectories.files import TrajectoryFormat, write_trajectory
from epipole.scene import Trajectory

_SUFFIXES = {"kitti": "_kitti.txt", "euroc": "_euroc.csv"}


def write_in_format(
    paths: Sequence[Trajectory], names: Sequence[str], format: TrajectoryFormat, folder: Path
) -> None:
    """Write trajectories in a format other than TUM, such as trajectory_kitti.txt or trajectory_euroc.csv.

    Args:
        paths: the trajectories.
        names: names of their TUM files.
        format: the format; nothing is written for "tum".
        folder: output folder.

    Raises:
        WorkspaceError: a file cannot be written.
    """
    for path, name in zip(paths, names):
        if format != "tum" and len(path):
            write_trajectory(path, folder / f"{Path(name).stem}{_SUFFIXES[format]}", format)


def missing_rows(path: Trajectory, num_frames: int, format: TrajectoryFormat) -> list[str]:
    """Warn if frames are missing in a KITTI file, whose line numbers are frame numbers."""
    if format != "kitti" or len(path) == num_frames:
        return []
    return [
        f"KITTI files have no timestamps, and {num_frames - len(path)} frames have no pose: lines are not frame numbers"
    ]
