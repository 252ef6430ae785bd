"""Pairs of frames from stereo video: two files, or one that holds both pictures side by side."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from epipole._declared import checked
from epipole.errors import ConfigError, FileFormatError, WorkspaceError
from epipole.io.atomic import atomic_write
from epipole.io.files import require_file
from epipole.io.video import count_frames, opened_video


@checked
def extract_pairs(left: Path, right: Path, folder: Path, max_frames: int) -> list[tuple[Path, Path]]:
    """Write evenly spaced pairs of frames as left/frame_000123.png and right/frame_000123.png.

    Args:
        left: a video; both pictures side by side where `right` is the same file.
        right: the other video, whose frames were taken at the same instants.
        folder: where to write; frames that are there already are not read again.
        max_frames: largest number of pairs.

    Raises:
        FileFormatError: a video cannot be read.
        ConfigError: max_frames is not positive.
        WorkspaceError: the folder cannot be used.
    """
    if max_frames < 1:
        raise ConfigError(f"max_frames must be at least 1, got {max_frames}")
    for video in (left, right):
        require_file(video)
    is_side_by_side = left.resolve() == right.resolve()
    videos = [left] if is_side_by_side else [left, right]
    count = min(count_frames(video)[0] for video in videos)
    captures = [opened_video(video) for video in videos]
    wanted = set(
        np.unique(np.linspace(0, max(count - 1, 0), min(max_frames, max(count, 1))).astype(int)).tolist()
    )
    pairs: list[tuple[Path, Path]] = []
    index = 0
    while index <= max(wanted):
        if not all(c.grab() for c in captures):
            break
        if index in wanted:
            frames = [c.retrieve() for c in captures]
            if not all(ok for ok, _ in frames):
                break
            pictures = [frame for _, frame in frames]
            if is_side_by_side:
                half = pictures[0].shape[1] // 2
                pictures = [pictures[0][:, :half], pictures[0][:, half : 2 * half]]
            paths = tuple(folder / side / f"frame_{index:06d}.png" for side in ("left", "right"))
            for path, picture in zip(paths, pictures):
                _write(path, picture)
            pairs.append((paths[0], paths[1]))
        index += 1
    if not pairs:
        raise FileFormatError(left, "it has no frame that can be read")
    return pairs


def _write(path: Path, picture: np.ndarray) -> None:
    """Write a frame, unless it is there: by its date a later run knows that a pair is measured."""
    encoded, data = cv2.imencode(".png", np.ascontiguousarray(picture))
    if not encoded:
        raise WorkspaceError(f"a frame cannot be written to {path}")
    if path.is_file() and path.read_bytes() == data.tobytes():
        return
    with atomic_write(path) as aside:
        aside.write_bytes(data.tobytes())
