"""The calibration job: from images of a board to calibrated cameras on disk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Unpack

import numpy as np

from epipole._checks import as_path
from epipole.cameras.image_fit import ImagePixels, ImageShape
from epipole.config import BoardConfig, options_of
from epipole.errors import DegenerateGeometryError, FileFormatError, MissingDependencyError
from epipole.features.boards import BoardView, find_board, whole_chessboard
from epipole.io.images.photographs import list_photographs, read_gray, read_header
from epipole.io.sequences.stereo_folders import pair_folders, pair_within
from epipole.pipelines.calibration.calibrate import calibrate_views
from epipole.pipelines.calibration.comparison import cross_check
from epipole.pipelines.calibration.config import CalibrationConfig
from epipole.pipelines.calibration.files import CalibrationRun, write_results
from epipole.pipelines.calibration.options import CalibrationKeywords
from epipole.pipelines.calibration.page import render_page
from epipole.pipelines.calibration.verdict import assess
from epipole.runs import Job, ProgressCallback, Run, ignore_progress, open_run

_NUM_INSPECTED = 8
_SIDES = (("left", "right"), ("cam0", "cam1"), ("image_0", "image_1"), ("l", "r"), ("0", "1"))


def calibrate(
    images: str | Path,
    out: str | Path,
    config: CalibrationConfig | None = None,
    right: str | Path | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Unpack[CalibrationKeywords],
) -> CalibrationRun:
    """Calibrate a camera, or a stereo pair, from images of a board, and write a report.

    Writes `calibration.json` (with covariances), `opencv.yaml`, `ros.yaml` for ROS (`ros_left.yaml` and `ros_right.yaml` for a pair)
    and `report.html`.

    Args:
        images: folder of images; for a pair with sub-folders left and right, or files left01.jpg and right01.jpg.
        out: output folder, created if missing.
        config: board and options.
        right: folder of the right camera's images, with the same names or in the same order.
        progress: called with the progress.
        **options: single options of the config or its board by name, which override it: `columns=9`.

    Raises:
        FileFormatError: there are no images, or the two folders do not match.
        DegenerateGeometryError: the board is detected too rarely, or the views do not constrain all parameters.
        WorkspaceError: the output folder cannot be used.
        ConfigError: an option is unknown, or its value is invalid.
    """
    config = options_of(CalibrationConfig, config, options, ["config", "right", "progress"])
    images = as_path(images)
    others = () if right is None else (as_path(right),)
    job = Job(
        kind="calibrate",
        inputs=(images, *others),
        settings={"config": asdict(config)},
        progress=progress,
    )
    with open_run(job, as_path(out)) as run:
        found = _measure(images_of_cameras(images, *others), run, config)
        for folder in (images, *others):
            for number, note in enumerate(list_photographs(folder).notes):
                found.problems[f"{folder} {number}"] = note
        with run.folder.publish("calibration") as aside:
            write_results(found, aside)
            (aside / "report.html").write_text(render_page(found), encoding="utf-8")
        run.finish()
        return found


def _measure(images: list[list[Path]], run: Run, config: CalibrationConfig) -> CalibrationRun:
    views, sizes, problems = _inspect_all(images, run, config)
    run.report("calibrate", 0, 2)
    against = _against(images, config.board)
    try:
        result = calibrate_views(views, sizes, config)
    except DegenerateGeometryError as error:
        raise DegenerateGeometryError("; ".join([str(error), *against])) from error
    run.report("calibrate", 1, 2)
    check = cross_check(views, result)
    if check is not None:
        result = replace(result, uncertainty=result.uncertainty.widened(check.widening))
    verdict = assess(result, check, against)
    run.report("calibrate", 2, 2)
    return CalibrationRun(run.root, result, check, verdict, tuple(tuple(p) for p in images), problems)


def _inspect_all(
    images: list[list[Path]], run: Run, config: CalibrationConfig
) -> tuple[list[list[BoardView]], list[tuple[int, int]], dict[str, str]]:
    """Views of the board and the image size of each camera, and problems of single images."""
    views: list[list[BoardView]] = []
    sizes: list[tuple[int, int]] = []
    problems: dict[str, str] = {}
    total, done = sum(len(p) for p in images), 0
    for own in images:
        found, shapes = [], []
        orientation, note = _common_orientation(own)
        problems |= note
        for path in own:
            view, shape = _inspect(path, config, problems, orientation)
            found.append(view)
            shapes.append(shape)
            done += 1
            run.report("board", done, total)
        size = _common_size(found, shapes, own, config.board)
        for k, shape in enumerate(shapes):
            if shape is not None and shape != size:
                problems[str(own[k])] = (
                    f"{own[k].name}: its size is {shape[0]} x {shape[1]} pixels, but that of the others {size[0]} x {size[1]}"
                )
                found[k] = BoardView(np.zeros(0, np.int64), np.zeros((0, 2)))
        views.append(found)
        sizes.append(size)
    return views, sizes, problems


def _against(images: Sequence[Sequence[Path]], board: BoardConfig) -> list[str]:
    """A reason to fail if the board is larger than specified, since a different part may be detected in each view."""
    if board.kind != "chessboard":
        return []
    size = whole_chessboard(_readable(images[0][:_NUM_INSPECTED]), board)
    if size is None:
        return []
    return [
        f"the board seems to have {size[0]} x {size[1]} inner corners, not {board.columns} x {board.rows}"
    ]


def _readable(images: Sequence[Path]) -> Iterator[np.ndarray]:
    for path in images:
        with suppress(FileFormatError):
            yield read_gray(path)


def images_of_cameras(images: Path, right: Path | None = None) -> list[list[Path]]:
    """Images of one camera, or of two in the same order; missing files are views of one camera only.

    Raises:
        FileFormatError: there are none, or left and right do not match.
    """
    if right is not None:
        pairs = [pair for _, pair in pair_folders(images, right)]
        return [[a for a, _ in pairs], [b for _, b in pairs]]
    for first, second in _SIDES:
        if (images / first).is_dir() and (images / second).is_dir():
            return images_of_cameras(images / first, images / second)
    every = _images(images)
    within = pair_within(images)
    return [[a for a, _ in within], [b for _, b in within]] if within else [every]


def _images(folder: Path) -> list[Path]:
    return [folder / name for name in list_photographs(folder).require_some().names]


def _common_orientation(images: Sequence[Path]) -> tuple[int | None, dict[str, str]]:
    """The EXIF orientation to apply to all images of one sensor (None: each image's own), and a note by its folder.

    Images with different orientations share a camera only as stored pixels, unless only the upright images have the same size.
    """
    shapes = []
    for path in images:
        with suppress(FileFormatError, MissingDependencyError):
            header = read_header(path)
            shapes.append(ImageShape(header.width, header.height, header.orientation))
    rotated = len({shape.orientation for shape in shapes})
    stored, upright = (len({shape.size(pixels) for shape in shapes}) for pixels in ImagePixels)
    if rotated < 2 or stored > upright:
        return None, {}
    note = (
        f"the images in {images[0].parent.name} have different EXIF orientations: the calibration describes their stored pixels,"
        " without EXIF orientation"
    )
    return 1, {f"{images[0].parent} {images[0].name}: orientation": note}


def _inspect(
    path: Path, config: CalibrationConfig, problems: dict[str, str], orientation: int | None
) -> tuple[BoardView, tuple[int, int] | None]:
    try:
        gray = read_gray(path, orientation=orientation)
    except FileFormatError as error:
        problems[str(path)] = str(error)
        return BoardView(np.zeros(0, np.int64), np.zeros((0, 2))), None
    return find_board(gray, config.board), (gray.shape[1], gray.shape[0])


def _requested(board: BoardConfig) -> str:
    size = f"{board.columns} x {board.rows}"
    if board.kind == "chessboard":
        return f"expected a chessboard with {size} inner corners"
    what = "a ChArUco board of squares" if board.kind == "charuco" else "a grid of AprilTags"
    return f"expected {what}, {size}, dictionary {board.dictionary_name}"


def _common_size(
    found: Sequence[BoardView],
    shapes: Sequence[tuple[int, int] | None],
    images: Sequence[Path],
    board: BoardConfig,
) -> tuple[int, int]:
    """The most frequent size of images with a board, or of all images if none has one."""
    with_board = [s for s, view in zip(shapes, found) if s is not None and len(view)]
    every = with_board or [s for s in shapes if s is not None]
    if not every:
        raise FileFormatError(images[0].parent, "none of its images can be read")
    if not with_board:
        raise DegenerateGeometryError(
            f"no board found in the {len(images)} images of {images[0].parent}: {_requested(board)}"
        )
    return max(sorted(set(every)), key=every.count)
