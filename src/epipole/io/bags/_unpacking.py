"""Compressed chunks, messages and files of recordings, unpacked within a budget: a few bytes may stand for gigabytes."""

from __future__ import annotations

import bz2
import io
import sys
from importlib import import_module
from types import SimpleNamespace
from typing import Any

from epipole.io.files import most_unpacked_bytes

_ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
"""It comes with rosbags, as lz4 does."""


def unpacked(compression: str, data: bytes) -> bytes:
    """What bytes of a recording hold: one frame of their compression after another.

    Raises:
        ValueError: the compression is not known, the data end early, or unpack to more than their budget.
    """
    if compression in ("", "none"):
        return data
    most, out = most_unpacked_bytes(len(data)), b""
    while data:
        frame = _decompressor(compression)
        try:
            out += frame.decompress(data, max_length=most + 1 - len(out))
        except Exception as error:  # each library has errors of its own
            raise ValueError(f"a chunk is damaged: {error}") from error
        if len(out) > most:
            raise ValueError(f"a chunk unpacks to more than {most} bytes")
        if not frame.eof:
            raise ValueError("a chunk ends early")
        data = frame.unused_data or b""
    return out


def _decompressor(compression: str) -> Any:
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    if compression == "lz4":
        return import_module("lz4.frame").LZ4FrameDecompressor()
    if compression == "zstd":
        return import_module(_ZSTD).ZstdDecompressor()
    raise ValueError(f"the compression {compression[:20]!r} is not known")


class _BoundedStream:
    """A file of zstd that is read to its budget, and no further."""

    def __init__(self, packed: io.BufferedIOBase, mode: str) -> None:
        self._stream = import_module(_ZSTD).open(packed, mode)
        at = packed.tell()
        self._left = most_unpacked_bytes(packed.seek(0, 2))
        packed.seek(at)

    def read(self, size: int) -> bytes:
        """The next bytes.

        Raises:
            ValueError: they are more than the budget.
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
    """Let rosbags unpack by the functions above: its own ask for whatever the data say."""
    ros1: Any
    ros2: Any
    ros1, ros2 = import_module("rosbags.rosbag1.reader"), import_module("rosbags.rosbag2.reader")
    mcap = import_module("rosbags.rosbag2.storage_mcap")
    for name in ("bz2", "lz4"):
        ros1.decompressors[name] = lambda data, name=name: unpacked(name, data)
    for name in ("lz4", "zstd"):
        mcap.DECOMPRESSORS[name] = lambda data, _size, name=name: unpacked(name, data)
    ros2.zstd = SimpleNamespace(decompress=lambda data: unpacked("zstd", data), open=_BoundedStream)
