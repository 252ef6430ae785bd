"""Decompression of chunks, messages and files in recordings with size limits: a few bytes can expand to gigabytes."""

from __future__ import annotations

import bz2
import io
import sys
from importlib import import_module
from types import SimpleNamespace
from typing import Any

from epipole.io.files import most_unpacked_bytes

_ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
"""Installed with rosbags, as is lz4."""


def unpacked(compression: str, data: bytes) -> bytes:
    """Decompress bytes of a recording, which consist of one or more compression frames.

    Raises:
        ValueError: the compression is unknown, or the data are truncated or unpack to more than their limit.
    """
    if compression in ("", "none"):
        return data
    most, out = most_unpacked_bytes(len(data)), b""
    while data:
        frame = _decompressor(compression)
        try:
            out += frame.decompress(data, max_length=most + 1 - len(out))
        except Exception as error:  # each library has its own exceptions
            raise ValueError(f"a chunk is damaged: {error}") from error
        if len(out) > most:
            raise ValueError(f"a chunk unpacks to more than {most} bytes")
        if not frame.eof:
            raise ValueError("a chunk is truncated")
        data = frame.unused_data or b""
    return out


def _decompressor(compression: str) -> Any:
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    if compression == "lz4":
        return import_module("lz4.frame").LZ4FrameDecompressor()
    if compression == "zstd":
        return import_module(_ZSTD).ZstdDecompressor()
    raise ValueError(f"unknown compression {compression[:20]!r}")


class _BoundedStream:
    """A zstd file that is unpacked up to a size limit."""

    def __init__(self, packed: io.BufferedIOBase, mode: str) -> None:
        self._stream = import_module(_ZSTD).open(packed, mode)
        at = packed.tell()
        self._left = most_unpacked_bytes(packed.seek(0, 2))
        packed.seek(at)

    def read(self, size: int) -> bytes:
        """The next bytes.

        Raises:
            ValueError: the limit is exceeded.
        """
        data: bytes = self._stream.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise ValueError("it unpacks to more than its size allows")
        return data

    def __enter__(self) -> _BoundedStream:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()


def bound_unpacking() -> None:
    """Make rosbags use the functions above, since its own allocate whatever the data claim."""
    ros1: Any
    ros2: Any
    ros1, ros2 = import_module("rosbags.rosbag1.reader"), import_module("rosbags.rosbag2.reader")
    mcap = import_module("rosbags.rosbag2.storage_mcap")
    for name in ("bz2", "lz4"):
        ros1.decompressors[name] = lambda data, name=name: unpacked(name, data)
    for name in ("lz4", "zstd"):
        mcap.DECOMPRESSORS[name] = lambda data, _size, name=name: unpacked(name, data)
    ros2.zstd = SimpleNamespace(decompress=lambda data: unpacked("zstd", data), open=_BoundedStream)
