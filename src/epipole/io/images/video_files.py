"""Writing of videos: VP9 in an MP4 file, which browsers and players support."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from epipole._checks import check_pixels, checked
from epipole.errors import ConfigError, WorkspaceError
from epipole.io.atomic import refuse_other_kinds

MOST_FPS = 1000
VIDEO_SUFFIX, CODEC = ".mp4", "vp09"
_COMPARED_SIDE = 8
"""Frames are compared with the written ones on a grid of this size, since compression changes details."""
_LARGEST_DIFFERENCE = 24.0
"""Mean difference between cells, of 255, up to which a frame read back matches the written one."""


def write_video(path: str | Path, images: Iterable[UInt8[np.ndarray, "h w 3"]], fps: float) -> None:
    """Write RGB images of one size as a video and verify it, since the encoder reports no errors.

    Video sizes are even: the last column or row of an odd size is dropped.

    Args:
        path: the file, with any suffix.
        images: the frames in order.
        fps: frames per second.

    Raises:
        ConfigError: the images differ in size, there are none, or `fps` is not in (0, 1000].
        WorkspaceError: the file cannot be written, or does not read back correctly (for example on a full disk).
    """
    path, fps = _target(path, fps)
    try:
        each = iter(images)
    except TypeError as error:  # a zero-dimensional array is an Iterable, too
        raise ConfigError(f"images must be images, got {images!r:.60}") from error
    aside = path.with_name(path.name + VIDEO_SUFFIX)  # OpenCV chooses the container by suffix
    writer, size, count = None, (0, 0), 0
    first = last = np.zeros((1, 1, 3), np.uint8)
    try:
        for image in map(_frame, each):  # one at a time: all of them may not fit into memory
            if writer is None:
                size = image.shape[1], image.shape[0]
                writer, first = _opened(aside, fps, size), image
            if (image.shape[1], image.shape[0]) != size:
                raise ConfigError(
                    "all images of a video must have the same size: pass a width, or render to a folder"
                )
            writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
            last, count = image, count + 1
        if writer is None:
            raise ConfigError("a video needs at least one image")
        writer.release()
        problem = _problem_of(aside, count, first, last)
        if problem:
            raise WorkspaceError(f"cannot write {path}: {problem}; is the disk full?")
        aside.replace(path)
    finally:
        if writer is not None:
            writer.release()
        with suppress(OSError):  # the folder may not exist
            aside.unlink(missing_ok=True)


@checked
def _target(path: str | Path, fps: float) -> tuple[Path, float]:
    if not 0 < fps <= MOST_FPS:
        raise ConfigError(f"fps must be above 0 and at most {MOST_FPS}, got {fps:g}")
    refuse_other_kinds(Path(path))
    return Path(path), fps


@checked
def _frame(image: UInt8[np.ndarray, "h w 3"]) -> np.ndarray:
    check_pixels(image.shape[1], image.shape[0])
    return image


def _problem_of(path: Path, count: int, first: np.ndarray, last: np.ndarray) -> str:
    if not path.is_file():
        return "the encoder wrote no file"
    capture, num_read = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG), 0
    try:
        while capture.grab():
            if num_read in (0, count - 1):
                is_read, frame = capture.retrieve()
                written = first if num_read == 0 else last
                if not is_read or not _is_like(frame[..., ::-1], written):
                    return f"frame {num_read + 1} of {count} does not match what was written"
            num_read += 1
    finally:
        capture.release()
    return "" if num_read == count else f"only {num_read} of {count} frames can be read back"


def _is_like(read: np.ndarray, written: np.ndarray) -> bool:
    written = written[: written.shape[0] & ~1, : written.shape[1] & ~1]
    if read.shape != written.shape:
        return False
    side = min(_COMPARED_SIDE, *written.shape[:2])
    cells = [
        cv2.resize(np.ascontiguousarray(each), (side, side), interpolation=cv2.INTER_AREA)
        for each in (read, written)
    ]
    return float(np.abs(cells[0].astype(np.float64) - cells[1]).mean()) <= _LARGEST_DIFFERENCE


def _opened(path: Path, fps: float, size: tuple[int, int]) -> cv2.VideoWriter:
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), fps, size)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not writer.isOpened():
        raise WorkspaceError(
            f"OpenCV cannot write the video (no codec {CODEC}, or {path.parent} does not exist)"
        )
    return writer
