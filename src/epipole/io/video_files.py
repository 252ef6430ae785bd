"""Videos that are written: VP9 in an MP4 file, which browsers and players show."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from epipole._checks import check_pixels
from epipole._declared import checked
from epipole.errors import ConfigError, WorkspaceError
from epipole.io.atomic import refuse_other_kinds

MOST_FPS = 1000
VIDEO_SUFFIX, CODEC = ".mp4", "vp09"


def write_video(path: str | Path, pictures: Iterable[UInt8[np.ndarray, "h w 3"]], fps: float) -> None:
    """Write RGB pictures of one size.

    Args:
        path: the file; its name may have any ending.
        pictures: one after the other.
        fps: pictures a second.

    Raises:
        ConfigError: the pictures differ in size, there is none, or the rate is not from 0 to 1000.
        WorkspaceError: the file cannot be written.
    """
    path, fps = _target(path, fps)
    try:
        each = iter(pictures)
    except TypeError as error:  # an array without axes is an Iterable, too
        raise ConfigError(f"pictures must be images, got {pictures!r:.60}") from error
    aside = path.with_name(path.name + VIDEO_SUFFIX)  # OpenCV takes the container from the ending
    writer, size = None, (0, 0)
    try:
        for picture in map(_frame, each):  # one after the other: all may not fit into the memory
            if writer is None:
                size = picture.shape[1], picture.shape[0]
                writer = _opened(aside, fps, size)
            if (picture.shape[1], picture.shape[0]) != size:
                raise ConfigError(
                    "the pictures of a video must be of one size: give a width, or draw to a folder"
                )
            writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        if writer is None:
            raise ConfigError("a video needs a picture")
        writer.release()
        if not aside.is_file():
            raise WorkspaceError(f"{path} could not be written")
        aside.replace(path)
    finally:
        if writer is not None:
            writer.release()
        aside.unlink(missing_ok=True)


@checked
def _target(path: str | Path, fps: float) -> tuple[Path, float]:
    if not 0 < fps <= MOST_FPS:
        raise ConfigError(f"fps must be above 0 and at most {MOST_FPS}, got {fps:g}")
    refuse_other_kinds(Path(path))
    return Path(path), fps


@checked
def _frame(picture: UInt8[np.ndarray, "h w 3"]) -> np.ndarray:
    check_pixels(picture.shape[1], picture.shape[0])
    return picture


def _opened(path: Path, fps: float, size: tuple[int, int]) -> cv2.VideoWriter:
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), fps, size)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not writer.isOpened():
        raise WorkspaceError(
            f"OpenCV cannot write a video here (no codec {CODEC}, or {path.parent} is not there)"
        )
    return writer
