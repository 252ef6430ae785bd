"""Extraction of photographs from a video: evenly spaced frames, each the sharpest in its neighborhood.

Sharpness is the variance of the Laplacian (Pech-Pacheco et al., Diatom autofocusing in brightfield
microscopy, ICPR 2000) of the gray frame at 640 pixels. The video is read once from start to end because seeking in
compressed video is not exact.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8

from epipole._checks import check_count, checked
from epipole.errors import ConfigError, FileFormatError, ShapeError
from epipole.image.encoding import encoded_image
from epipole.io._spherical import refuse_spherical_video
from epipole.io.atomic import atomic_folder
from epipole.io.files import open_file, read_json, require_file
from epipole.io.images.pixels import rotation
from epipole.io.json_files import json_text

VIDEO_SUFFIXES = frozenset(
    {
        ".mp4",
        ".mov",
        ".avi",
        ".mkv",
        ".m4v",
        ".webm",
        ".mpg",
        ".mpeg",
        ".wmv",
        ".mts",
        ".m2ts",
        ".3gp",
        ".insv",
        ".360",
        ".ts",
        ".ogv",
        ".flv",
    }
)
SPHERICAL_SUFFIXES = frozenset({".insv", ".360"})
"""Raw recordings of 360-degree cameras: each frame contains several fisheye images, or faces of a cube."""

_MANIFEST = "frames.json"
_FRAME = re.compile(r"frame_[0-9]{6,12}\.jpg")
_MAX_WINDOW = 7
_SHARPNESS_SIZE_PX = 640
_JPEG_QUALITY = 95
_HEAD = 256
_MOST_FRAME_PX = 1 << 26
_LISTS_FRAMES = re.compile(rb"....(?:ftyp|moov|mdat|wide|free|skip)|RIFF....AVI ", re.DOTALL)
"""First bytes of containers that list their frames."""


@dataclass(frozen=True, slots=True, eq=False)
class VideoFrames:
    """Frames extracted from a video, in order."""

    name: tuple[str, ...]
    """File names relative to the folder."""
    index: Int64[np.ndarray, " n"]
    """Frame number in the video, from 0."""
    timestamp_s: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.name)

    def __repr__(self) -> str:
        span_s = float(np.ptp(self.timestamp_s)) if len(self) else 0.0
        return f"VideoFrames({len(self)} over {span_s:.1f} s)"


@checked
def is_video(path: Path | str) -> bool:
    """Whether a path is a file with a video suffix."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES and Path(path).is_file()


@checked
def frame_size(path: Path | str) -> tuple[int, int] | None:
    """Width and height of a video's frames; None if unknown.

    Raises:
        FileFormatError: the file is not a readable video.
    """
    capture = opened_video(Path(path))
    size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    return size if min(size) > 0 else None


@checked
def frame_orientation(path: Path | str) -> int:
    """The EXIF orientation equivalent to the rotation in a video's metadata; 1 for none. Frames are read upright.

    Raises:
        FileFormatError: the file is not a readable video.
    """
    capture = opened_video(Path(path))
    try:
        if not capture.get(cv2.CAP_PROP_ORIENTATION_META) or not capture.get(cv2.CAP_PROP_ORIENTATION_AUTO):
            return 1
        is_read, upright = capture.read()
    finally:
        capture.release()
    raw = opened_video(Path(path))
    try:
        raw.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        is_stored, stored = raw.read()
    finally:
        raw.release()
    if not (is_read and is_stored):
        return 1
    rotated = {orientation: rotation(stored, orientation) for orientation in (1, 3, 6, 8)}
    return next((o for o, frame in rotated.items() if np.array_equal(frame, upright)), 1)


@checked
def extract_frames(
    video: Path | str,
    folder: Path | str,
    *,
    max_frames: int = 200,
    every_s: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> VideoFrames:
    """Write evenly spaced sharp frames of a video as frame_000123.jpg (numbered as in the video).

    The folder, which also gets a `frames.json`, is written atomically. A second call with the same video and options
    does not read the video again; with other options it replaces the frames listed in `frames.json`.

    Args:
        video: the file.
        folder: output folder; created if missing.
        max_frames: largest number of frames.
        every_s: seconds between frames; None spreads `max_frames` over the video.
        progress: called with (frames read, frames in the video).

    Raises:
        FileFormatError: not a video, damaged, or it ends before half of the frames that its header announces.
        ConfigError: `max_frames` or `every_s` is not positive.
    """
    video, folder = Path(video), Path(folder)
    if max_frames < 1:
        raise ConfigError(f"max_frames must be at least 1, got {max_frames}")
    if every_s is not None and not every_s > 0.0:
        raise ConfigError(f"every_s must be positive, got {every_s}")
    request = {
        "video": video.name,
        "bytes": require_file(video),
        "modified_ns": video.stat().st_mtime_ns,
        "max_frames": max_frames,
        "every_s": every_s,
    }
    earlier = _read_manifest(folder)
    if (
        earlier is not None
        and earlier[0] == request
        and len(earlier[1]) <= max_frames
        and all((folder / n).is_file() for n in earlier[1].name)
    ):
        return earlier[1]
    with atomic_folder(folder, stale=earlier[1].name if earlier is not None else ()) as part:
        frames = _extract(video, part, max_frames, every_s, progress)
        _write_manifest(part, request, frames)
    return frames


@checked
def slot_bounds(num_frames: int, num_slots: int) -> Int64[np.ndarray, "n 2"]:
    """Divide range(num_frames) into equal slots; returns the (first, last) frame of the window in the middle of each.

    Raises:
        ConfigError: `num_slots` is zero, or a number is negative or too large.
    """
    check_count(num_frames, "num_frames", 1 << 53)
    check_count(num_slots, "num_slots")
    if num_slots < 1:
        raise ConfigError("num_slots must be positive")
    edges = np.linspace(0.0, num_frames, num_slots + 1)
    middle = np.floor(0.5 * (edges[:-1] + edges[1:])).astype(np.int64)
    half = min(_MAX_WINDOW, max(1, num_frames // (2 * num_slots))) // 2
    return np.stack([np.maximum(middle - half, 0), np.minimum(middle + half, num_frames - 1)], axis=1)


@checked
def sharpness(bgr: UInt8[np.ndarray, "h w *channels"]) -> float:
    """Variance of the Laplacian of a frame, in color or gray, at 640 pixels.

    Raises:
        ShapeError: the frame has no pixels, or neither one nor three channels.
    """
    if not bgr.size or bgr.ndim > 3 or bgr.shape[2:] not in ((), (3,)):
        raise ShapeError(f"bgr must be (h, w, 3) or (h, w), got {bgr.shape}")
    gray = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY) if bgr.ndim == 3 else bgr
    scale = _SHARPNESS_SIZE_PX / max(gray.shape)
    if scale < 1.0:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def _extract(
    video: Path,
    folder: Path,
    max_frames: int,
    every_s: float | None,
    progress: Callable[[int, int], None] | None,
) -> VideoFrames:
    num_frames, fps = count_frames(video)
    num_slots = max_frames
    if every_s is not None:
        if fps is None:
            raise ConfigError(f"Unknown frame rate of {video}: pass max_frames instead of every_s")
        num_slots = round(min(max_frames, max(1.0, num_frames / max(fps * every_s, 1e-12))))
    windows = slot_bounds(num_frames, min(num_slots, num_frames))
    names, indices, times = [], [], []
    if progress is not None:
        progress(0, num_frames)
    for index, time_s, frame in _sharpest(video, windows, num_frames, fps):
        name = f"frame_{index:06d}.jpg"
        (folder / name).write_bytes(encoded_image(".jpg", frame, _JPEG_QUALITY))
        names.append(name)
        indices.append(index)
        times.append(time_s)
        if progress is not None:
            progress(index + 1, num_frames)
    return VideoFrames(tuple(names), np.array(indices, np.int64), np.array(times, np.float64))


@checked
def opened_video(video: Path) -> cv2.VideoCapture:
    """Open a video for sequential reading.

    Raises:
        FileFormatError: the file is missing, not a readable video, or spherical.
    """
    with open_file(video) as stream:
        head = stream.read(_HEAD)
        if video.suffix.lower() in SPHERICAL_SUFFIXES:
            raise FileFormatError(
                video,
                f"this is a raw recording of a 360-degree camera ({video.suffix}), whose frames contain several fisheye images: "
                "export a flat perspective video (.mp4) with the manufacturer's software and use that",
            )
        refuse_spherical_video(video, stream)
    # FFmpeg would open the addresses and file names in a playlist.
    if all(32 <= byte < 127 or byte in b"\t\n\r\f\v" for byte in head):
        raise FileFormatError(video, f"not a video: the file is {'text' if head else 'empty'}")
    try:
        capture = cv2.VideoCapture(str(video))
    except cv2.error as error:
        raise FileFormatError(video, f"not a readable video ({error.err})") from error
    if not capture.isOpened():
        raise FileFormatError(video, "not a readable video: damaged, truncated or in an unknown format")
    width, height = (capture.get(side) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if width * height > _MOST_FRAME_PX:
        raise FileFormatError(video, f"frames of {width:g} x {height:g} pixels are too large")
    return capture


@checked
def announced_frames(video: Path, capture: cv2.VideoCapture) -> tuple[int, bool]:
    """Number of frames that a video announces (0 if none), and whether its container counts them.

    MP4, QuickTime and AVI list their frames. For others (Matroska, WebM, transport streams), FFmpeg multiplies duration
    and frame rate, which can be far off if the frame rate varies.
    """
    announced = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    with open_file(video) as stream:
        is_counted = _LISTS_FRAMES.match(stream.read(_HEAD)) is not None
    return (int(announced) if 0 < announced < 1e9 else 0), is_counted


@checked
def count_frames(video: Path) -> tuple[int, float | None]:
    """Number of frames and frames per second (None if unknown); reads the video if its container does not count frames.

    Raises:
        FileFormatError: no frame can be decoded, or the video ends before half of its duration.
    """
    capture = opened_video(video)
    try:
        num_frames, is_counted = announced_frames(video, capture)
        fps = capture.get(cv2.CAP_PROP_FPS)
        if num_frames == 0 or not is_counted:
            duration_s = num_frames / fps if fps > 0.0 else 0.0
            num_frames, last_s = 0, 0.0
            while capture.grab():
                num_frames += 1
                last_s = max(last_s, capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0)
            if 0.0 < last_s < 0.5 * duration_s:
                problem = f"it ends after {last_s:.1f} of {duration_s:.1f} s"
                raise FileFormatError(video, f"the video is damaged: {problem}")
            fps = (num_frames - 1) / last_s if last_s > 0.0 else fps
    finally:
        capture.release()
    if num_frames == 0:
        raise FileFormatError(video, "no frame of the video can be decoded")
    return num_frames, float(fps) if 0.0 < fps < 1e5 else None


def _sharpest(
    video: Path, windows: np.ndarray, num_frames: int, fps: float | None
) -> Iterator[tuple[int, float, np.ndarray]]:
    """Index, time and pixels of the sharpest frame of each window, in order.

    Raises:
        FileFormatError: the video ends before half of its frames, or has none.
    """
    capture = opened_video(video)
    num_read = 0
    try:
        for first, last in windows:
            best: tuple[int, float, np.ndarray] | None = None
            best_sharpness = -1.0
            while num_read <= last and capture.grab():
                index, num_read = num_read, num_read + 1
                if index < first:
                    continue
                time_s = _time_s(capture, index, fps)
                decoded, frame = capture.retrieve()
                if decoded and (value := sharpness(frame)) > best_sharpness:
                    best, best_sharpness = (index, time_s, frame.copy()), value
            if best is not None:
                yield best
            if num_read <= last:
                break
    finally:
        capture.release()
    if 2 * num_read < num_frames and num_read <= windows[-1, 1]:
        raise FileFormatError(video, f"the video is damaged: it ends after {num_read} of {num_frames} frames")


def _time_s(capture: cv2.VideoCapture, index: int, fps: float | None) -> float:
    """Time of the frame just grabbed; computed from its number if the container has none."""
    time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
    if index > 0 and not time_s > 0.0:
        return index / fps if fps is not None else float("nan")
    return max(time_s, 0.0)


def _read_manifest(folder: Path) -> tuple[dict[str, Any], VideoFrames] | None:
    """Request and frames of an earlier call; None if there is no readable manifest."""
    try:
        content = read_json(folder / _MANIFEST)
        rows = content["frames"]
        if len({row["name"] for row in rows}) < max(len(rows), 1) or not all(
            _FRAME.fullmatch(row["name"]) for row in rows
        ):  # these files are read, and removed when stale
            return None
        frames = VideoFrames(
            tuple(row["name"] for row in rows),
            np.array([row["index"] for row in rows], np.int64),
            np.array([np.nan if row["time_s"] is None else row["time_s"] for row in rows], np.float64),
        )
        return content["request"], frames
    except (OSError, ValueError, KeyError, TypeError, OverflowError):
        return None


def _write_manifest(folder: Path, request: dict[str, Any], frames: VideoFrames) -> None:
    rows = [
        {"name": name, "index": int(index), "time_s": float(time_s) if np.isfinite(time_s) else None}
        for name, index, time_s in zip(frames.name, frames.index, frames.timestamp_s)
    ]
    text = json_text({"request": request, "frames": rows}, indent=1)
    (folder / _MANIFEST).write_text(text, encoding="utf-8")
