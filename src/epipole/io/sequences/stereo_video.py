"""Pairs of frames from stereo video: two files, or one with both images side by side."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.image.encoding import encoded_image
from epipole.io.atomic import atomic_write
from epipole.io.files import require_file
from epipole.io.images.video import count_frames, opened_video


@checked
def extract_pairs(
    left: Path,
    right: Path,
    folder: Path,
    max_frames: int,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> list[tuple[Path, Path]]:
    """Write evenly spaced pairs of frames as left/frame_000123.png and right/frame_000123.png.

    Args:
        left: a video; side-by-side images if `right` is the same file.
        right: the other video, synchronized with the left one.
        folder: output folder; unchanged frames are not written again.
        max_frames: largest number of pairs.
        progress: called with (frames read, frames to read).

    Raises:
        FileFormatError: a video cannot be read.
        ConfigError: max_frames is not positive.
        WorkspaceError: the folder cannot be written.
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
        progress(index, max(wanted) + 1)
        if not all(c.grab() for c in captures):
            break
        if index in wanted:
            frames = [c.retrieve() for c in captures]
            if not all(ok for ok, _ in frames):
                break
            images = [frame for _, frame in frames]
            if is_side_by_side:
                half = images[0].shape[1] // 2
                images = [images[0][:, :half], images[0][:, half : 2 * half]]
            paths = tuple(folder / side / f"frame_{index:06d}.png" for side in ("left", "right"))
            for path, image in zip(paths, images):
                _write(path, image)
            pairs.append((paths[0], paths[1]))
        index += 1
    progress(max(wanted) + 1, max(wanted) + 1)
    if not pairs:
        raise FileFormatError(left, "it has no readable frame")
    return pairs


def _write(path: Path, image: np.ndarray) -> None:
    """Write a frame, unless the file already has this content: a later run uses its date to skip finished pairs."""
    data = encoded_image(".png", image)
    if path.is_file() and path.read_bytes() == data:
        return
    with atomic_write(path) as aside:
        aside.write_bytes(data)
