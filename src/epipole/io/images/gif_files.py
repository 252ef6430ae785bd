"""Animated GIFs, written frame by frame: Pillow would keep all frames in memory, and merge equal ones.

Pillow compresses each frame as a separate GIF, whose palette and data become one image of the animation (GIF89a,
https://www.w3.org/Graphics/GIF/spec-gif89a.txt).
"""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
from PIL import Image

from epipole.errors import WorkspaceError

COLORS = 256
_HEADER = struct.Struct("<6sHHBBB")
_LOOP_FOREVER = b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"
_CONTROL = struct.Struct("<3sBHBB")
_DESCRIPTOR = struct.Struct("<BHHHHB")
_KEEP = 1 << 2
"""Disposal: the next frame is put over this one."""
_EXTENSION, _IMAGE, _END = 0x21, 0x2C, b"\x3b"
_HAS_PALETTE, _PALETTE_BITS = 0x80, 7
MOST_SIDE = 0xFFFF
"""Largest width and height of a GIF."""


class GifWriter:
    """An animated GIF with one palette per frame; of each frame, the part that changed is stored."""

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        """Open the file.

        Raises:
            WorkspaceError: the file cannot be written, or the images are too large for a GIF.
        """
        if max(size) > MOST_SIDE:
            raise WorkspaceError(f"cannot write {path}: a GIF has at most {MOST_SIDE} pixels per side")
        self._path, self._fps, self._count = path, fps, 0
        self._shown: np.ndarray | None = None
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise WorkspaceError(f"cannot write {path}: {error}") from error
        self._put(_HEADER.pack(b"GIF89a", *size, 0, 0, 0) + _LOOP_FOREVER)

    def write(self, image: np.ndarray) -> None:
        """Write an RGB image (h, w, 3).

        Raises:
            WorkspaceError: the file cannot be written.
        """
        indexed = Image.fromarray(image).quantize(COLORS)
        left, top, right, bottom = self._changed(np.asarray(indexed.convert("RGB")))
        palette, data = _compressed(indexed.crop((left, top, right, bottom)))
        size_bits = (len(palette) // 3).bit_length() - 2
        delay = round(100 * (self._count + 1) / self._fps) - round(100 * self._count / self._fps)
        self._put(
            _CONTROL.pack(b"\x21\xf9\x04", _KEEP, min(delay, 0xFFFF), 0, 0)
            + _DESCRIPTOR.pack(_IMAGE, left, top, right - left, bottom - top, _HAS_PALETTE | size_bits)
            + palette
            + data
        )
        self._count += 1

    def release(self) -> None:
        """Close the file.

        Raises:
            WorkspaceError: the file cannot be written.
        """
        if not self._file.closed:
            self._put(_END)
            try:
                self._file.close()
            except OSError as error:
                raise self._error(error) from error

    def _changed(self, shown: np.ndarray) -> tuple[int, int, int, int]:
        """Left, top, right and bottom of what differs from the previous frame; at least one pixel."""
        before, self._shown = self._shown, shown
        if before is None:
            return 0, 0, shown.shape[1], shown.shape[0]
        differs = (before != shown).any(axis=2)
        rows, columns = np.flatnonzero(differs.any(axis=1)), np.flatnonzero(differs.any(axis=0))
        if not len(rows):
            return 0, 0, 1, 1
        return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1

    def _put(self, data: bytes) -> None:
        try:
            self._file.write(data)
        except OSError as error:
            raise self._error(error) from error

    def _error(self, error: OSError) -> WorkspaceError:
        return WorkspaceError(f"cannot write {self._path}: {error}; is the disk full?")


def gif_problem(path: Path, count: int, first: np.ndarray) -> str:
    """Why a written GIF does not read back as written; empty if it does.

    Args:
        path: the file.
        count: number of frames.
        first: the first frame, for the size.
    """
    try:
        with Image.open(path) as gif:
            size, num_read = gif.size, getattr(gif, "n_frames", 1)
            for number in range(num_read):
                gif.seek(number)
                gif.load()
    except (OSError, EOFError, ValueError) as error:
        return f"it cannot be read back ({error})"
    if size != (first.shape[1], first.shape[0]):
        return f"it has {size[0]} x {size[1]} pixels, not {first.shape[1]} x {first.shape[0]}"
    return "" if num_read == count else f"only {num_read} of {count} frames can be read back"


def _compressed(indexed: Image.Image) -> tuple[bytes, bytes]:
    """Palette and compressed data of an image with a palette."""
    stream = io.BytesIO()
    indexed.save(stream, "GIF", interlace=False)
    data = stream.getvalue()
    at = _HEADER.size
    num_palette = 3 << ((data[10] & _PALETTE_BITS) + 1) if data[10] & _HAS_PALETTE else 0
    palette, at = data[at : at + num_palette], at + num_palette
    while data[at] == _EXTENSION:
        at += 2
        while data[at]:
            at += data[at] + 1
        at += 1
    flags = data[at + _DESCRIPTOR.size - 1]
    at += _DESCRIPTOR.size
    if flags & _HAS_PALETTE:
        num_palette = 3 << ((flags & _PALETTE_BITS) + 1)
        palette, at = data[at : at + num_palette], at + num_palette
    return palette, data[at:].removesuffix(_END)
