"""Pictures of a board to calibrated cameras on disk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from epipole.calibration.board import BoardView, find_board, whole_chessboard
from epipole.calibration.calibrate import Calibration, calibrate
from epipole.calibration.comparison import CrossCheck, cross_check
from epipole.calibration.verdict import Verdict, judge
from epipole.config import BoardConfig, CalibrationConfig
from epipole.errors import DegenerateGeometryError, FileFormatError, WorkspaceError
from epipole.io.atomic import atomic_folder
from epipole.io.calibration_files import CalibrationFile, write_calibration, write_opencv_yaml
from epipole.io.photographs import list_photographs, read_grey
from epipole.io.stereo_folders import pair_folders, pair_within
from epipole.workflow import Progress, ProgressCallback, ignore_progress

_LOOKED_AT = 8
_SIDES = (("left", "right"), ("cam0", "cam1"), ("image_0", "image_1"), ("l", "r"), ("0", "1"))


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationRun:
    """What `run_calibration` has found and written."""

    out: Path
    calibration: Calibration
    check: CrossCheck | None
    verdict: Verdict
    pictures: tuple[tuple[Path, ...], ...]
    """[camera][view]"""
    problems: dict[str, str]
    """Pictures that could not be read, and why."""

    def __repr__(self) -> str:
        return f"CalibrationRun({self.calibration!r}, {self.verdict.sentence!r}, in {self.out})"


def run_calibration(
    images: Path,
    out: Path,
    config: CalibrationConfig,
    right: Path | None = None,
    progress: ProgressCallback = ignore_progress,
) -> CalibrationRun:
    """Find the board in every picture, calibrate, check, and write `calibration.json` and `opencv.yaml`.

    Args:
        images: folder of one camera's pictures; or of a pair's: with the sub-folders left and right, or files
            named left01.jpg, right01.jpg.
        out: output folder.
        config: options.
        right: folder of the right camera's pictures, of the same names or in the same order.
        progress: called after each picture.

    Raises:
        FileFormatError: there are no pictures, or the two folders do not fit.
        DegenerateGeometryError: the board is seen too seldom, or the views leave something open.
        WorkspaceError: the output folder cannot be used.
    """
    if out.exists() and not out.is_dir():
        raise WorkspaceError(f"{out} is a file; the output must be a folder")
    if out.resolve() in (images.resolve(), right and right.resolve()):
        raise WorkspaceError(f"{out} is the folder of the pictures: choose another for the results")
    pictures = pictures_of_cameras(images, right)
    views: list[list[BoardView]] = []
    sizes: list[tuple[int, int]] = []
    problems: dict[str, str] = {}
    total, done = sum(len(p) for p in pictures), 0
    for own in pictures:
        found, shapes = [], []
        for path in own:
            view, shape = _look(path, config, problems)
            found.append(view)
            shapes.append(shape)
            done += 1
            progress(Progress("board", done, total))
        size = _common_size(found, shapes, own, config.board)
        for k, shape in enumerate(shapes):
            if shape is not None and shape != size:
                problems[str(own[k])] = (
                    f"{own[k].name}: it is {shape[0]} x {shape[1]} pixels, the others {size[0]} x {size[1]}"
                )
                found[k] = BoardView(np.zeros(0, np.int64), np.zeros((0, 2)))
        views.append(found)
        sizes.append(size)
    progress(Progress("calibrate", 0, 2))
    against = _against(pictures, config.board)
    try:
        result = calibrate(views, sizes, config)
    except DegenerateGeometryError as error:
        raise DegenerateGeometryError("; ".join([str(error), *against])) from error
    progress(Progress("calibrate", 1, 2))
    check = cross_check(views, result)
    if check is not None:
        result = replace(result, uncertainty=result.uncertainty.widened(check.widening))
    verdict = judge(result, check, against)
    progress(Progress("calibrate", 2, 2))
    content = calibration_file(result)
    with atomic_folder(out) as aside:
        write_calibration(aside / "calibration.json", content, _about(result, verdict, check))
        write_opencv_yaml(aside / "opencv.yaml", content)
    return CalibrationRun(out, result, check, verdict, tuple(tuple(p) for p in pictures), problems)


def _against(pictures: Sequence[Sequence[Path]], board: BoardConfig) -> list[str]:
    """Whether the board is larger than was said: a part of it is found as readily, another part in each view."""
    if board.kind != "chessboard":
        return []
    size = whole_chessboard(_readable(pictures[0][:_LOOKED_AT]), board)
    if size is None:
        return []
    return [
        f"the board seems to have {size[0]} x {size[1]} inner corners, not {board.columns} x {board.rows}"
    ]


def _readable(pictures: Sequence[Path]) -> Iterator[np.ndarray]:
    for path in pictures:
        with suppress(FileFormatError):
            yield read_grey(path)


def calibration_file(found: Calibration) -> CalibrationFile:
    """What is written of a calibration."""
    covariance = found.rig().covariance if len(found.cameras) == 2 else None
    return CalibrationFile(found.cameras, found.state.cam_from_rig, covariance)


def pictures_of_cameras(images: Path, right: Path | None = None) -> list[list[Path]]:
    """Pictures of one camera, or of two in the same order, where some may not exist: views of one camera alone.

    Raises:
        FileFormatError: there are none, or left and right do not fit.
    """
    if right is not None:
        pairs = [pair for _, pair in pair_folders(images, right)]
        return [[a for a, _ in pairs], [b for _, b in pairs]]
    for first, second in _SIDES:
        if (images / first).is_dir() and (images / second).is_dir():
            return pictures_of_cameras(images / first, images / second)
    every = _pictures(images)
    within = pair_within(images)
    return [[a for a, _ in within], [b for _, b in within]] if within else [every]


def _pictures(folder: Path) -> list[Path]:
    names = list_photographs(folder).names
    if not names:
        raise FileFormatError(folder, "there is no picture in it")
    return [folder / name for name in names]


def _look(
    path: Path, config: CalibrationConfig, problems: dict[str, str]
) -> tuple[BoardView, tuple[int, int] | None]:
    try:
        grey = read_grey(path)
    except FileFormatError as error:
        problems[str(path)] = str(error)
        return BoardView(np.zeros(0, np.int64), np.zeros((0, 2))), None
    return find_board(grey, config.board), (grey.shape[1], grey.shape[0])


def _asked_for(board: BoardConfig) -> str:
    size = f"{board.columns} x {board.rows}"
    if board.kind == "chessboard":
        return f"a chessboard of {size} inner corners was asked for"
    what = "a ChArUco board of squares" if board.kind == "charuco" else "a grid of AprilTags"
    return f"{what}, {size}, dictionary {board.dictionary_name}, was asked for"


def _common_size(
    found: Sequence[BoardView],
    shapes: Sequence[tuple[int, int] | None],
    pictures: Sequence[Path],
    board: BoardConfig,
) -> tuple[int, int]:
    """The size of most pictures with a board (of most pictures where there is none)."""
    with_board = [s for s, view in zip(shapes, found) if s is not None and len(view)]
    every = with_board or [s for s in shapes if s is not None]
    if not every:
        raise FileFormatError(pictures[0].parent, "none of its pictures can be read")
    if not with_board:
        raise DegenerateGeometryError(
            f"the board is in none of the {len(pictures)} pictures of {pictures[0].parent}: {_asked_for(board)}"
        )
    return max(sorted(set(every)), key=every.count)


def _about(found: Calibration, verdict: Verdict, check: CrossCheck | None) -> dict[str, object]:
    about: dict[str, object] = {
        "verdict": verdict.sentence,
        "rms_px": found.rms_px,
        "corner_noise_px": found.uncertainty.noise_px,
        "sigmas_widened_by": None if check is None else check.widening,
        "params_sigma": [
            dict(zip(camera.model.param_names, found.params_sigma(c).tolist()))
            for c, camera in enumerate(found.cameras)
        ],
        "board_warp": found.state.warp.tolist(),
    }
    if len(found.cameras) == 2:
        about |= {"baseline": found.rig().baseline, "baseline_sigma": found.baseline_sigma()}
    return about
