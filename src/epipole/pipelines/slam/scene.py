"""What the viewer shows of a followed camera: its path, keyframes, points and loops."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import EpipoleError, FileFormatError
from epipole.io.convert import read_model
from epipole.io.files import read_json
from epipole.io.frame_tables import FRAME_TABLE, read_frame_table
from epipole.io.photographs import read_rgb
from epipole.io.sequences import read_sequence
from epipole.io.trajectories import read_trajectory
from epipole.pipelines.slam.drawing import (
    CAUSAL,
    CAUSAL_RGB,
    FINAL,
    FINAL_RGB,
    loop_curve,
    path_curve,
    upright_from_world,
)
from epipole.runs.folder import read_mark
from epipole.viewer import ViewerHandle, view

TRAJECTORY, CAUSAL_TRAJECTORY = "trajectory.txt", "trajectory_causal.txt"
PICTURE_PX = 640


def is_mine(path: Path) -> bool:
    """Whether a folder holds the path of a followed camera."""
    return (path / CAUSAL_TRAJECTORY).is_file() and (path / TRAJECTORY).is_file()


def show(path: Path, *, port: int | None, host: str, block: bool) -> ViewerHandle:
    """The map's points, keyframes with their pictures where they are still there, the path and the loops.

    Raises:
        FileFormatError: there is no map, or a file is damaged.
    """
    if not (path / "sparse" / "0").is_dir():
        raise FileFormatError(path, "holds a path, but no map: a single keyframe has none")
    model = read_model(path / "sparse" / "0")
    final, causal = read_trajectory(path / TRAJECTORY), read_trajectory(path / CAUSAL_TRAJECTORY)
    numbers = _frame_numbers(path)
    loops = loop_curve(_loops(path), model, [numbers.get(name, -1) for name in model.images.name])
    curves = (
        path_curve(FINAL, final, FINAL_RGB),
        path_curve(CAUSAL, causal, CAUSAL_RGB, is_shown=False),
        loops,
    )
    upright = upright_from_world(final.world_from_body)
    return view(
        model.transformed(upright),
        picture_loader(path),
        port=port,
        host=host,
        block=block,
        curves=tuple(curve.transformed(upright) for curve in curves if len(curve.segments_in_world)),
    )


def picture_loader(out: Path) -> Callable[[str], np.ndarray | None]:
    """Reads a keyframe's picture from the frames that the path was made from; gives None where they are gone."""
    mark = read_mark(out)
    files: dict[str, Path] = {}
    if mark is not None and mark.source.paths:
        try:
            frames = read_sequence(mark.source.paths[0]).frames
        except EpipoleError:
            frames = ()
        files = {frame.picture.name: frame.picture for frame in frames}

    def load_picture(name: str) -> np.ndarray | None:
        try:
            return read_rgb(files[name], PICTURE_PX) if name in files else None
        except FileFormatError:
            return None

    return load_picture


def _loops(path: Path) -> list[dict[str, Any]]:
    """Of the summary; none where it has none."""
    summary = read_json(path / "summary.json")
    loops = summary.get("loops", []) if isinstance(summary, dict) else []
    return [loop for loop in loops if isinstance(loop, dict)] if isinstance(loops, list) else []


def _frame_numbers(path: Path) -> dict[str, int]:
    """Numbers of the frames by their pictures' names; those that were dropped or left out are not counted."""
    if not (path / FRAME_TABLE).is_file():
        return {}
    table = read_frame_table(path / FRAME_TABLE)
    followed = np.flatnonzero(np.isfinite(table.timestamp_s))
    return {table.picture[row]: number for number, row in enumerate(followed)}
