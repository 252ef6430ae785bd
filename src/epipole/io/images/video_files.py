"""Writing of videos: H.264 in an MP4 file where PyAV is installed, otherwise VP9; and animated GIFs.

Every player shows H.264, browsers and VLC also show VP9. The wheels of OpenCV cannot write H.264.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from fractions import Fraction
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8

from epipole._checks import check_pixels, checked
from epipole.errors import ConfigError, WorkspaceError
from epipole.io.atomic import refuse_other_kinds
from epipole.io.images.gif_files import GifWriter, gif_problem

MOST_FPS = 1000
VIDEO_SUFFIX, GIF_SUFFIX = ".mp4", ".gif"
CODEC = "vp09"
"""What OpenCV writes: VP9."""
SLOWEST = Fraction(1, 1001)
"""Smallest frame rate of H.264 here."""
H264_QUALITY = "18"
"""Constant rate factor of x264, visually lossless."""
MOST_GIF_FPS = 50.0
"""Browsers slow down GIFs with shorter delays than 2/100 s."""
_COMPARED_SIDE = 8
"""Frames are compared with the written ones on a grid of this size, since compression changes details."""
_LARGEST_DIFFERENCE = 24.0
"""Mean difference between cells, of 255, up to which a frame read back matches the written one."""


@runtime_checkable
class VideoWriter(Protocol):
    """What writes the frames of one file."""

    def write(self, image: np.ndarray) -> None:
        """Write an RGB image (h, w, 3)."""

    def release(self) -> None:
        """Write what is left and close the file."""


def write_video(path: str | Path, images: Iterable[UInt8[np.ndarray, "h w 3"]], fps: float) -> None:
    """Write RGB images of one size as a video and verify it, since the encoder reports no errors.

    Video sizes are even: the last column or row of an odd size is dropped. A GIF has 256 colors per frame, a frame rate of
    at most 50, and keeps odd sizes.

    Args:
        path: the file; the suffix .gif makes a GIF, any other an MP4 file.
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
    is_gif = path.suffix.lower() == GIF_SUFFIX
    aside = path.with_name(
        path.name + (GIF_SUFFIX if is_gif else VIDEO_SUFFIX)
    )  # OpenCV chooses the container by suffix
    writer, size, count = None, (0, 0), 0
    first = last = np.zeros((1, 1, 3), np.uint8)
    try:
        for image in map(_frame, each):  # one at a time: all of them may not fit into memory
            if writer is None:
                size = image.shape[1], image.shape[0]
                writer, first = _writer_of(aside, fps, size), image
            if (image.shape[1], image.shape[0]) != size:
                raise ConfigError(
                    "all images of a video must have the same size: pass a width, or render to a folder"
                )
            writer.write(image)
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
            with suppress(Exception):  # the error that led here is the one to report
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
    return (
        gif_problem(path, count, first)
        if path.suffix == GIF_SUFFIX
        else _video_problem(path, count, first, last)
    )


def _video_problem(path: Path, count: int, first: np.ndarray, last: np.ndarray) -> str:
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


def _writer_of(path: Path, fps: float, size: tuple[int, int]) -> VideoWriter:
    if path.suffix == GIF_SUFFIX:
        return GifWriter(path, min(fps, MOST_GIF_FPS), size)
    if find_spec("av") is not None and min(size) >= 2:
        return _H264Writer(path, fps, size)
    return _OpenCvWriter(path, fps, size)


class _OpenCvWriter:
    """VP9."""

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            self._writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), fps, size)
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not self._writer.isOpened():
            raise WorkspaceError(
                f"OpenCV cannot write the video (no codec {CODEC}, or {path.parent} does not exist)"
            )

    def write(self, image: np.ndarray) -> None:
        self._writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))

    def release(self) -> None:
        self._writer.release()


class _H264Writer:
    """H.264 by PyAV."""

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        self._av: Any = import_module("av")
        try:
            self._file = self._av.open(str(path), "w")
            self._stream = self._file.add_stream(
                "libx264", rate=max(Fraction(fps).limit_denominator(1001), SLOWEST)
            )
        except (OSError, ValueError) as error:
            raise WorkspaceError(f"cannot write {path}: {error}") from error
        self._stream.width, self._stream.height = (side & ~1 for side in size)
        self._stream.pix_fmt, self._stream.options = "yuv420p", {"crf": H264_QUALITY}
        self._is_open = True

    def write(self, image: np.ndarray) -> None:
        even = np.ascontiguousarray(image[: self._stream.height, : self._stream.width])
        self._mux(self._av.VideoFrame.from_ndarray(even, format="rgb24"))

    def _mux(self, frame: Any) -> None:
        try:
            self._file.mux(self._stream.encode(frame))
            if frame is None:
                self._file.close()
        except OSError as error:
            raise WorkspaceError(f"cannot write the video: {error}; is the disk full?") from error

    def release(self) -> None:
        if self._is_open:
            self._is_open = False
            self._mux(None)
