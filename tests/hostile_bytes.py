"""Files that are cut, flipped, grown, repeated or full of impossible numbers, and what a reader may do with them."""

import struct
import threading
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

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
