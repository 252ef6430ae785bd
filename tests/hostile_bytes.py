"""Files that are cut, flipped, grown, repeated or full of impossible numbers, and what a reader may do with them."""

import re
import struct
import threading
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from epipole.errors import EpipoleError

MOST_BYTES = 48 << 20
"""More than this no reader may take for the small files of these tests."""
MOST_SECONDS = 10.0
"""Of the processor, not of the clock: other work on the machine does not count."""

NUMBERS = (
    *("0", "-1", "1", "-0.0", "0.5", "255", "256", "65536", "2147483647", "2147483648", "-2147483649"),
    *("1099511627776", "9223372036854775807", "9223372036854775808", "-9223372036854775809"),
    *("1e-320", "1e160", "-1e308", "1e400", "nan", "NaN", "inf", "-Infinity", "1e", "0x10", "1_0", ""),
    *("9" * 4300, "9" * 5000, "word", "null", "[]", '"', "{}", "true", "1.5e3", "\u0661"),
)
"""What stands in the place of a number of a text file."""
WORDS = (
    *(struct.pack("<I", v) for v in (0, 1, 0xFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)),
    *(struct.pack("<Q", v) for v in (0, 1, 1 << 31, 1 << 40, 1 << 61, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)),
    *(struct.pack(">I", v) for v in (1, 0x10000, 0x7FFFFFFF)),
    *(struct.pack("<d", v) for v in (0.0, -1.0, 1e-320, 1e160, -1e308, float("inf"), float("nan"))),
)
"""What stands in the place of a count or a value of a binary file."""
_NUMBER = re.compile(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")
_LINE = re.compile(rb"[^\n]*\n?")


@st.composite
def _cut(draw: st.DrawFn, data: bytes) -> bytes:
    return data[: draw(st.integers(0, len(data)))]


@st.composite
def _flip(draw: st.DrawFn, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(draw(st.integers(1, 4)) if out else 0):
        out[draw(st.integers(0, len(out) - 1))] ^= draw(st.integers(1, 255))
    return bytes(out)


@st.composite
def _grow(draw: st.DrawFn, data: bytes) -> bytes:
    at = draw(st.integers(0, len(data)))
    return data[:at] + draw(st.binary(min_size=1, max_size=20) | st.sampled_from(WORDS)) + data[at:]


@st.composite
def _piece(draw: st.DrawFn, data: bytes) -> tuple[int, int]:
    first = draw(st.integers(0, len(data)))
    return first, min(len(data), first + draw(st.integers(0, 200)))


@st.composite
def _repeat(draw: st.DrawFn, data: bytes) -> bytes:
    first, last = draw(_piece(data))
    return data[:last] + data[first:last] * draw(st.integers(1, 3)) + data[last:]


@st.composite
def _leave_out(draw: st.DrawFn, data: bytes) -> bytes:
    first, last = draw(_piece(data))
    return data[:first] + data[last:]


@st.composite
def _other_word(draw: st.DrawFn, data: bytes) -> bytes:
    word = draw(st.sampled_from(WORDS))
    at = draw(st.integers(0, max(0, len(data) - len(word))))
    return data[:at] + word + data[at + len(word) :]


@st.composite
def _other_number(draw: st.DrawFn, data: bytes) -> bytes:
    found = list(_NUMBER.finditer(data))
    if not found:
        return data
    position = draw(st.sampled_from(found))
    return data[: position.start()] + draw(st.sampled_from(NUMBERS)).encode() + data[position.end() :]


@st.composite
def _other_line(draw: st.DrawFn, data: bytes) -> bytes:
    """A line once more, left out, or in the place of another."""
    lines = _LINE.findall(data)
    taken, put = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
    keep = draw(st.integers(0, 2))
    lines[put : put + 1] = [lines[put], lines[taken]][: keep + 1] if keep else []
    return b"".join(lines)


@st.composite
def spoilt(draw: st.DrawFn, data: bytes, *, is_text: bool) -> bytes:
    """The bytes of a valid file after one to three kinds of damage."""
    common = [_cut, _flip, _grow, _repeat, _leave_out]
    own = [_other_number, _other_number, _other_number, _other_line] if is_text else [_other_word] * 4
    for _ in range(draw(st.integers(1, 3))):
        data = draw(draw(st.sampled_from([*common, *own]))(data))
    return data


def read_or_refuse(read: Callable[..., Any], *arguments: Any, names: str = "") -> Any | None:
    """What a reader makes of its file; None where it refuses it with an error of ours that has `names` in it.

    Any other exception passes; too much memory or time is an assertion's failure.
    """
    _wait_for_kernels()
    start = time.process_time()
    tracemalloc.start()
    try:
        return read(*arguments)
    except EpipoleError as error:
        assert names in str(error), f"the message does not name {names}: {error}"
        assert len(str(error)) < 20_000
        return None
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < MOST_BYTES, f"reading took {peak >> 20} MB"
        assert time.process_time() - start < MOST_SECONDS


def _wait_for_kernels() -> None:
    """Until nothing is compiled or run behind a test: a job that was refused leaves its thread to warm up kernels.

    Before Python 3.12.9 and 3.13.2 the process crashes where tracing begins or ends while a thread without the
    interpreter's lock takes memory (python/cpython#128679).
    """
    for thread in threading.enumerate():
        if thread.name == "epipole-compile":
            thread.join()


def assert_motions(motions: Any) -> None:
    """Every row is a motion, or NaN throughout."""
    rotation, translation = motions.rotation.reshape(-1, 3, 3), motions.translation.reshape(-1, 3)
    known = np.isfinite(translation).all(axis=1) & np.isfinite(rotation).all(axis=(1, 2))
    assert np.isnan(rotation[~known]).all() and np.isnan(translation[~known]).all()
    product = rotation[known] @ np.swapaxes(rotation[known], 1, 2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-3)


def assert_model(model: Any) -> None:
    """A reconstruction whose rows refer to rows that are there."""
    assert_motions(model.cams_from_world())
    assert np.isfinite(model.cameras.params).all()
    counts = np.diff(model.images.keypoint_offsets)
    assert (counts >= 0).all() and model.images.keypoint_offsets[-1] == len(model.images.keypoints_px)
    assert (model.tracks.keypoint < counts[model.tracks.image]).all()
    assert model.tracks.offsets[-1] == len(model.tracks.image)
    assert len(model.tracks) == len(model.points)


def spoil_one(folder: Path, valid: dict[str, bytes], name: str, data: bytes) -> None:
    """Write all valid files but one, which is spoilt."""
    folder.mkdir(exist_ok=True)
    for other, content in valid.items():
        (folder / other).write_bytes(data if other == name else content)
