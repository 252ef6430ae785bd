"""Sizes of SPZ files, held against their bytes before anything is unpacked: headers may promise more than there is.

Before version 4 one gzip stream holds the header and all numbers; from then on the header stands first, then a table of zstd
streams, one for each kind of number (github.com/nianticlabs/spz).
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from epipole.errors import FileFormatError, MissingDependencyError
from epipole.io._finite_gaussians import MOST_GAUSSIANS
from epipole.io.files import read_by_others

_MAGIC, _HEADER, _ENTRY = b"NGSP", struct.Struct("<4sIIBBBB"), struct.Struct("<QQ")
_TABLE_AT = struct.Struct("<I")
_DEGREE_0, _BY_DEGREE = 20, (0, 9, 24, 45, 72)
"""Bytes of a Gaussian without higher harmonics, and those of the harmonics up to each degree."""
_SMALL_BYTES, _MOST_RATIO = 1 << 24, 32
"""The budget: a file may unpack to 16 MiB, or to 32 times its own size where that is more. Real ones shrink to a half or a third."""
_SPARE_BYTES = 1 << 16
"""Of extensions that may follow the numbers."""
_UNKNOWN_SIZE = (1 << 64) - 1


def check_spz(path: Path, data: bytes) -> None:
    """Check that a file unpacks to what its header says, and to no more than its size allows.

    Raises:
        FileFormatError: it does not, or is no SPZ file.
    """
    is_packed_whole = data[:4] != _MAGIC
    head = _unpacked(path, data, _HEADER.size) if is_packed_whole else data[: _HEADER.size]
    if len(head) < _HEADER.size or head[:4] != _MAGIC:
        raise FileFormatError(path, "is no SPZ file")
    _, _, count, degree, *_ = _HEADER.unpack(head)
    if count > MOST_GAUSSIANS:
        raise FileFormatError(path, f"promises {count} Gaussians, more than {MOST_GAUSSIANS}")
    if degree >= len(_BY_DEGREE):
        raise FileFormatError(path, f"has harmonics of degree {degree}, more than {len(_BY_DEGREE) - 1}")
    promised, most = count * (_DEGREE_0 + _BY_DEGREE[degree]), max(_SMALL_BYTES, _MOST_RATIO * len(data))
    if promised > most:
        raise FileFormatError(path, f"promises {count} Gaussians in {len(data)} bytes")
    if not is_packed_whole:
        _check_streams(path, data, promised)
    elif len(_unpacked(path, data, promised + _SPARE_BYTES)) == promised + _SPARE_BYTES:
        raise FileFormatError(path, f"unpacks to more than its {count} Gaussians need")


def _unpacked(path: Path, data: bytes, most: int) -> bytes:
    """The first bytes of a gzip stream, at most so many."""
    try:
        return zlib.decompressobj(31).decompress(data, most)
    except zlib.error as error:
        raise FileFormatError(path, f"is no SPZ file ({error})") from error


def _check_streams(path: Path, data: bytes, promised: int) -> None:
    """Check that the frame of each zstd stream says the size of the table: what a frame says is taken before it is unpacked."""
    try:
        import zstandard
    except ImportError as error:
        raise MissingDependencyError(
            f"{path} is packed with zstd; to read it: pip install zstandard"
        ) from error
    if len(data) < _HEADER.size + _TABLE_AT.size:
        raise FileFormatError(path, "is cut short")
    num_streams, (table,) = data[_HEADER.size - 1], _TABLE_AT.unpack_from(data, _HEADER.size)
    at = table + num_streams * _ENTRY.size
    if at > len(data):
        raise FileFormatError(path, "is cut short")
    total = 0
    for n in range(num_streams):
        packed, size = _ENTRY.unpack_from(data, table + n * _ENTRY.size)
        total += size
        if at + packed > len(data) or total > promised:
            raise FileFormatError(path, f"its stream {n} is larger than the file or its Gaussians")
        with read_by_others(path, f"its stream {n} is damaged"):
            told = zstandard.get_frame_parameters(data[at : at + packed]).content_size
        if told not in (size, _UNKNOWN_SIZE):
            raise FileFormatError(path, f"its stream {n} unpacks to {told} bytes, not {size}")
        at += packed
