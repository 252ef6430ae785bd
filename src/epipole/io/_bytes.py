"""Bounds-checked reading of binary files that may be truncated or contain wrong sizes."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from epipole.errors import FileFormatError
from epipole.io.files import file_bytes as file_bytes
from epipole.io.files import file_text as file_text

_COUNT = struct.Struct("<Q")


class ByteReader:
    """A cursor over a file's bytes that never reads past the end and rejects impossible counts."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path = path
        self.data = data
        self.position = 0

    @property
    def remaining(self) -> int:
        """Bytes not read yet."""
        return len(self.data) - self.position

    def fail(self, problem: str) -> FileFormatError:
        """The error to raise for a problem at the current position."""
        return FileFormatError(self.path, f"byte {self.position}: {problem}")

    def advance(self, size: int, what: str) -> int:
        """Skip `size` bytes and return the offset of the first of them."""
        if size > self.remaining:
            raise self.fail(f"the file ends inside {what} ({self.remaining} of {size} bytes)")
        start = self.position
        self.position += size
        return start

    def values(self, layout: struct.Struct, what: str) -> tuple:
        """The next fixed-size values."""
        return layout.unpack_from(self.data, self.advance(layout.size, what))

    def count(self, min_item_size: int, what: str) -> int:
        """The next 64-bit number of items, each of which takes at least `min_item_size` bytes."""
        (number,) = self.values(_COUNT, f"the number of {what}")
        self.require_room(number, min_item_size, what)
        return number

    def require_room(self, number: int, min_item_size: int, what: str) -> None:
        """Check that `number` items fit into the remaining bytes."""
        if number * min_item_size > self.remaining:
            raise self.fail(f"{number} {what} do not fit into the remaining {self.remaining} bytes")

    def array(self, dtype: DTypeLike, number: int, what: str) -> np.ndarray:
        """The next `number` values, as a read-only view."""
        start = self.advance(number * np.dtype(dtype).itemsize, what)
        return np.frombuffer(self.data, dtype, number, start)

    def string(self, what: str) -> str:
        """The next null-terminated UTF-8 text."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise self.fail(f"the file ends inside {what}")
        try:
            text = self.data[self.position : end].decode()
        except UnicodeDecodeError as error:
            raise self.fail(f"{what} is not UTF-8 text") from error
        self.position = end + 1
        return text

    def finish(self) -> None:
        """Check that all bytes have been read."""
        if self.remaining:
            raise self.fail(f"{self.remaining} unexpected bytes after the end")
