"""SPZ as other programs write it: versions that epipole reads and does not write."""

import gzip
import struct
from pathlib import Path

import numpy as np
import zstandard

_HARMONICS = (0, 9, 24, 45)


def write_packed_whole(path: Path, version: int, count: int, degree: int) -> None:
    """Random numbers in the layout of version 2: a header and columns in one gzip stream."""
    size = 19 + _HARMONICS[degree]
    numbers = np.random.default_rng(version).integers(0, 256, count * size, np.uint8)
    head = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, 0)
    path.write_bytes(gzip.compress(head + numbers.tobytes(), mtime=0))


def write_streams(path: Path, count: int, degree: int) -> None:
    """Random numbers in the layout of version 4: a header, a table, and a zstd stream of each column."""
    rng = np.random.default_rng(0)
    columns = [rng.integers(0, 256, size * count, np.uint8).tobytes() for size in (9, 1, 3, 3, 4)]
    if degree:
        columns.append(rng.integers(0, 256, _HARMONICS[degree] * count, np.uint8).tobytes())
    streams = [zstandard.ZstdCompressor().compress(column) for column in columns]
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, 12, 0, len(streams), 32)
    table = b"".join(struct.pack("<QQ", len(one), len(column)) for one, column in zip(streams, columns))
    path.write_bytes(head + table + b"".join(streams))
