"""Videos whose frame rate varies, in containers that do not count their frames."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from epipole.errors import FileFormatError
from epipole.io.images.video import count_frames, extract_frames
from epipole.io.sequences.stereo_video import extract_pairs

NUM_FRAMES, SIZE = 40, (96, 64)
SEGMENT, INFO, CLUSTER, DURATION, TIME, SIMPLE_BLOCK = (
    *(0x18538067, 0x1549A966, 0x1F43B675),
    *(0x4489, 0xE7, 0xA3),
)


def number(data: bytes, at: int, keep_marker: bool) -> tuple[int, int]:
    """An EBML number and where it ends."""
    length = 9 - data[at].bit_length()
    value = int.from_bytes(data[at : at + length], "big")
    return (value if keep_marker else value & ~(1 << 7 * length)), at + length


def elements(data: bytes, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Kind, start and end of the contents of all elements, with those within segments, infos and clusters."""
    while at < end:
        kind, at = number(data, at, True)
        size, at = number(data, at, False)
        stop = min(at + size, end)
        yield kind, at, stop
        if kind in (SEGMENT, INFO, CLUSTER):
            yield from elements(data, at, stop)
        at = stop


def varying_video(path: Path, late_ms: int = 400) -> Path:
    """Twenty frames at 25 Hz, and twenty that are 400 ms apart."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SIZE)
    for k in range(NUM_FRAMES):
        writer.write(np.full((SIZE[1], SIZE[0], 3), 5 * k, np.uint8))
    writer.release()
    data = bytearray(path.read_bytes())
    times = [40 * k if k < 20 else 800 + late_ms * (k - 20) for k in range(NUM_FRAMES)]
    blocks = base = 0
    for kind, start, stop in list(elements(bytes(data), 0, len(data))):
        if kind == DURATION:
            data[start : start + 8] = struct.pack(">d", times[-1] + late_ms)
        if kind == TIME:
            base = int.from_bytes(data[start:stop], "big")
        if kind == SIMPLE_BLOCK:
            data[start + 1 : start + 3] = struct.pack(">h", times[blocks] - base)
            blocks += 1
    assert blocks == NUM_FRAMES
    path.write_bytes(bytes(data))
    return path


@pytest.mark.parametrize("suffix", ["mkv", "webm"])
def test_frames_are_counted_and_spread_over_the_whole_video(tmp_path: Path, suffix: str) -> None:
    video = varying_video(tmp_path / "v.mkv").rename(tmp_path / f"v.{suffix}")
    assert cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FRAME_COUNT) > 2 * NUM_FRAMES  # an estimate
    count, fps = count_frames(video)
    assert count == NUM_FRAMES and fps == pytest.approx(39 / 8.4, rel=0.01)
    frames = extract_frames(video, tmp_path / "out", max_frames=8)
    assert np.abs(frames.index - (np.arange(8) * 5 + 2)).max() <= 2
    assert frames.timestamp_s[-1] > 6.0
    spaced = extract_frames(video, tmp_path / "spaced", every_s=1.0)
    assert 8 <= len(spaced) <= 10


def test_pairs_are_spread_over_the_whole_video(tmp_path: Path) -> None:
    video = varying_video(tmp_path / "v.mkv")
    pairs = extract_pairs(video, video, tmp_path / "out", 4)
    assert [left.name for left, _ in pairs] == [f"frame_{k:06d}.png" for k in (0, 13, 26, 39)]


def test_a_video_that_is_cut_off_is_still_damaged(tmp_path: Path) -> None:
    video = varying_video(tmp_path / "v.mkv")
    data = video.read_bytes()
    starts = [start for kind, start, _ in elements(data, 0, len(data)) if kind == SIMPLE_BLOCK]
    video.write_bytes(data[: starts[25]])
    with pytest.raises(FileFormatError, match="damaged: it ends after"):
        extract_frames(video, tmp_path / "out", max_frames=8)
