"""A seal inside a file that records which epipole command wrote it and detects later changes.

The seal is a line of text in a comment of the file's format: `epipole-seal COMMAND DIGEST`. The digest is BLAKE2b of
the file with zeros instead of the digest. Formats without comments (.splat, .usdc, .chan) are not sealed.
"""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from zipfile import ZipFile

from epipole.errors import WorkspaceError

_DIGITS = 64
_SEAL = re.compile(rb"epipole-seal ([a-z-]{1,40}) ([0-9a-f]{%d})" % _DIGITS)
_SEARCHED_BYTES = 1 << 16
"""Seals are searched in this many bytes at the start and end of the file."""
_CHUNK_BYTES = 1 << 20


def add_seal(path: Path, command: str) -> None:
    """Seal a file that was just written; formats without comments stay unchanged.

    Args:
        path: the file.
        command: the command that wrote it, in lower case.

    Raises:
        WorkspaceError: the seal cannot be read back.
        OSError: the file cannot be written.
    """
    with path.open("rb") as stream:
        head = stream.read(16)
    insert = next((each for is_it, each in _FORMATS if is_it(head)), None)
    if insert is None:
        return
    insert(path, f"epipole-seal {command} {'0' * _DIGITS}".encode())
    found = _found(path)
    if found is None:  # a header of unusual length
        return
    with path.open("r+b") as stream:
        stream.seek(found[1])
        stream.write(_digest(path, found[1]).encode())
    if sealed_by(path) != command:
        raise WorkspaceError(f"{path} could not be sealed")


def sealed_by(path: Path) -> str | None:
    """The command that sealed a file; None if it has no seal or has changed since.

    Raises:
        OSError: the file cannot be read.
    """
    found = _found(path)
    if found is None:
        return None
    command, start, digits = found
    return command if _digest(path, start) == digits else None


def _found(path: Path) -> tuple[str, int, str] | None:
    """Command, offset of the digest, and digest of the last seal."""
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        for start in (max(0, size - _SEARCHED_BYTES), 0):
            stream.seek(start)
            seals = list(_SEAL.finditer(stream.read(_SEARCHED_BYTES)))
            if seals:
                return seals[-1][1].decode(), start + seals[-1].start(2), seals[-1][2].decode()
    return None


def _digest(path: Path, start: int) -> str:
    """Digest of the file with zeros in place of the digest at `start`."""
    state = hashlib.blake2b(digest_size=_DIGITS // 2)
    with path.open("rb") as stream:
        left = start
        while left:
            block = stream.read(min(left, _CHUNK_BYTES))
            state.update(block)
            left -= len(block)
        state.update(b"0" * len(stream.read(_DIGITS)))
        while block := stream.read(_CHUNK_BYTES):
            state.update(block)
    return state.hexdigest()


def _append_to_html(path: Path, seal: bytes) -> None:
    with path.open("ab") as stream:
        stream.write(b"\n<!-- " + seal + b" -->\n")


def _append_to_usda(path: Path, seal: bytes) -> None:
    with path.open("ab") as stream:
        stream.write(b"\n# " + seal + b"\n")


def _append_to_mp4(path: Path, seal: bytes) -> None:
    """Append a box of type `free`, which players skip (ISO/IEC 14496-12, section 8.1.2)."""
    with path.open("ab") as stream:
        stream.write((8 + len(seal)).to_bytes(4, "big") + b"free" + seal)


def _append_to_gif(path: Path, seal: bytes) -> None:
    """Put a comment extension before the trailer (GIF89a, section 24)."""
    with path.open("r+b") as stream:
        stream.seek(-1, 2)
        if stream.read(1) != b";":
            return
        stream.seek(-1, 2)
        stream.write(b"!\xfe" + bytes([len(seal)]) + seal + b"\0;")


def _insert_into_ply(path: Path, seal: bytes) -> None:
    with path.open("rb") as stream:
        head = stream.read(_SEARCHED_BYTES)
    end = head.find(b"end_header")
    if end > 0:
        _replace_head(path, end, head[:end] + b"comment " + seal + b"\n")


def _comment_on_zip(path: Path, seal: bytes) -> None:
    with ZipFile(path, "a") as archive:
        archive.comment = seal


def _comment_on_gzip(path: Path, seal: bytes) -> None:
    """Set the header comment (RFC 1952, section 2.3); headers with other fields stay unchanged."""
    with path.open("rb") as stream:
        head = stream.read(10)
    _replace_head(path, 10, head[:3] + b"\x10" + head[4:10] + seal + b"\0")


def _replace_head(path: Path, size: int, head: bytes) -> None:
    """Replace the first `size` bytes of a file, which may be larger than memory."""
    longer = path.with_name(path.name + ".sealed")
    try:
        with path.open("rb") as source, longer.open("wb") as out:
            source.seek(size)
            out.write(head)
            shutil.copyfileobj(source, out, _CHUNK_BYTES)
        longer.replace(path)
    finally:
        longer.unlink(missing_ok=True)


_FORMATS: tuple[tuple[Callable[[bytes], bool], Callable[[Path, bytes], None]], ...] = (
    (lambda head: head.lower().startswith(b"<!doctype html"), _append_to_html),
    (lambda head: head[4:8] == b"ftyp", _append_to_mp4),
    (lambda head: head.startswith(b"GIF89a"), _append_to_gif),
    (lambda head: head.startswith(b"#usda "), _append_to_usda),
    (lambda head: head.startswith((b"ply\n", b"ply\r\n")), _insert_into_ply),
    (lambda head: head.startswith(b"PK\x03\x04"), _comment_on_zip),
    (lambda head: head.startswith(b"\x1f\x8b\x08\x00"), _comment_on_gzip),
)
