"""Checks of a LAS or LAZ file before laspy and lazrs read it: both allocate memory for any size that the file claims."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, BinaryIO

from epipole.errors import FileFormatError
from epipole.io.files import SMALL_BYTES

_HEADER = struct.Struct("<4s20xBB68xHIIBHI")
"""Signature, version, header size, offset of the points, number of VLRs, point format, point size, number of points."""
_COUNT_AT = 247
"""Offset of the number of points since LAS 1.4."""
_LEAST_HEADER, _VLR = 227, 54
"""Least number of bytes of the header, and of a variable-length record."""
_LAYERS = {6: 9, 7: 10, 8: 11, 9: 10, 10: 12}
"""Number of compressed layers in a chunk, by point format, without those of extra bytes."""
_MOST_RATIO = 1032
"""Largest ratio of unpacked to packed points that is read, or 64 MiB if that is more."""


def require_sound_header(path: Path, stream: BinaryIO, num_bytes: int) -> None:
    """Check the sizes in the header, and go back to the start of the file.

    Raises:
        FileFormatError: not a LAS or LAZ file, truncated, or a size is impossible.
    """
    head = stream.read(375)
    stream.seek(0)
    if not head.startswith(b"LASF"):
        raise FileFormatError(path, "not a LAS or LAZ file (it does not start with LASF)")
    if len(head) < _LEAST_HEADER:
        raise FileFormatError(path, f"the file ends inside its header ({len(head)} bytes)")
    _, major, minor, header_size, points_at, num_vlrs, point_format, point_size, count = _HEADER.unpack_from(
        head
    )
    if major != 1 or minor > 4:
        raise FileFormatError(path, f"LAS version {major}.{minor} is not supported; convert it to LAS 1.4")
    if minor >= 4 and len(head) >= _COUNT_AT + 8:
        (count,) = struct.unpack_from("<Q", head, _COUNT_AT)
    if not _LEAST_HEADER <= header_size <= points_at <= num_bytes:
        problem = (
            f"the header has {header_size} bytes and the points start at {points_at}, of {num_bytes} bytes"
        )
        raise FileFormatError(path, problem)
    if num_vlrs * _VLR > points_at - header_size:
        raise FileFormatError(path, f"{num_vlrs} records do not fit between the header and the points")
    is_packed = point_format & 0x80
    most = max(SMALL_BYTES, _MOST_RATIO * num_bytes) if is_packed else num_bytes - points_at
    if count * point_size > most:
        problem = f"{count} points of {point_size} bytes do not fit into a file of {num_bytes} bytes"
        raise FileFormatError(path, problem)


def require_sound_chunks(path: Path, stream: BinaryIO, header: Any, packing: Any) -> None:
    """Check the chunks of compressed points, and go back to the start of the points.

    Args:
        path: the file, for error messages.
        stream: the open file.
        header: its `laspy.LasHeader`.
        packing: its `lazrs.LazVlr`.

    Raises:
        FileFormatError: the points have another size, or a chunk or one of its layers exceeds the file.
    """
    import lazrs

    kind, size, first = header.point_format.id, header.point_format.size, header.offset_to_point_data
    if packing.item_size() != size:
        raise FileFormatError(path, f"points have {size} bytes, but {packing.item_size()} if unpacked")
    num_bytes = stream.seek(0, 2)
    table_at = _table_offset(path, stream, first, num_bytes)
    stream.seek(table_at)
    _, num_chunks = struct.unpack("<II", stream.read(8))
    if num_chunks > header.point_count:
        raise FileFormatError(path, f"{num_chunks} chunks for {header.point_count} points")
    stream.seek(first)
    chunks = lazrs.read_chunk_table(stream, packing)
    if sum(num_points for num_points, _ in chunks) < header.point_count:
        raise FileFormatError(path, f"its {num_chunks} chunks have less than {header.point_count} points")
    at = first + 8
    for number, (_, num_packed) in enumerate(chunks):
        if num_packed > table_at - at:
            raise FileFormatError(path, f"chunk {number}: {num_packed} bytes exceed the chunks' total size")
        if kind in _LAYERS:
            # A point, the number of points, the sizes of the layers, and the layers.
            sizes = struct.Struct(f"<{_LAYERS[kind] + header.point_format.num_extra_bytes}I")
            stream.seek(at + size + 4)
            head = stream.read(sizes.size)
            if len(head) < sizes.size or size + 4 + sizes.size + sum(sizes.unpack(head)) != num_packed:
                raise FileFormatError(path, f"chunk {number}: its layers do not have {num_packed} bytes")
        at += num_packed
    stream.seek(first)


def _table_offset(path: Path, stream: BinaryIO, first: int, num_bytes: int) -> int:
    """Offset of the chunk table, which is before the points, or at the end of files that were written as a stream."""
    for at in (first, num_bytes - 8) if first + 8 <= num_bytes else ():
        stream.seek(at)
        (offset,) = struct.unpack("<q", stream.read(8))
        if first + 8 <= offset <= num_bytes - 8:
            return int(offset)
        if offset != -1:
            break
    raise FileFormatError(path, "the table of its chunks is missing; the file is truncated or damaged")
