"""Opening files safely: rejects missing files, endless ones (pipes, devices), and ones larger than memory."""

from __future__ import annotations

import io
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from typing import Any

from epipole.errors import EpipoleError, FileFormatError
from epipole.io.json_files import json_values

MOST_JSON_BYTES = 1 << 28
"""Size limit of JSON files."""

SMALL_BYTES, MOST_RATIO = 1 << 26, 32
"""Limit of decompressed data: 64 MiB, or 32 times the compressed size if that is more."""
_MOST_NAME_BYTES = 4096
_MOST_LISTED = 1000
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def most_unpacked_bytes(num_packed: int, small_bytes: int = SMALL_BYTES) -> int:
    """Number of bytes that `num_packed` compressed bytes may unpack to; at least `small_bytes`."""
    return max(small_bytes, MOST_RATIO * num_packed)


MAX_ERROR_LENGTH = 300
"""A library's error message is cut to this length: it may quote the file."""


@contextmanager
def read_by_others(path: Path, problem: str) -> Iterator[None]:
    """Convert any exception that a library raises on damaged bytes: no list of its exceptions would be complete.

    Raises:
        FileFormatError: reading the file in the block failed.
    """
    try:
        yield
    except EpipoleError:
        raise
    except Exception as error:
        words = str(error).strip().splitlines() or [type(error).__name__]
        raise FileFormatError(path, f"{problem}: {words[0][:MAX_ERROR_LENGTH]}") from error


def missing_in_words(path: Path) -> str:
    """Problem and advice for a path that does not exist: a similar name next to it, or the first folder that is missing."""
    try:
        folder = path.parent
        if folder.is_dir():
            names = [each.name for each in islice(folder.iterdir(), _MOST_LISTED)]
            near = get_close_matches(path.name, names, 1, 0.75)
            advice = (
                f"did you mean {folder / near[0]}?"
                if near
                else f"check the name (the folder is {folder.resolve()})"
            )
            return f"it does not exist; {advice}"
        missing = next(each for each in reversed([path, *path.parents]) if not each.exists())
    except (OSError, ValueError, StopIteration):
        return "it does not exist; check the name"
    return f"it does not exist; check the path: {missing.resolve()} is missing"


def require_file(path: Path) -> int:
    """The size of a regular file in bytes; pipes and devices, which may never end, are rejected.

    Raises:
        FileFormatError: there is no such file, or the path is not a regular file.
    """
    try:
        status = path.stat()
    except FileNotFoundError as error:
        raise FileFormatError(path, missing_in_words(path)) from error
    except OSError as error:
        raise FileFormatError(path, f"cannot be opened: {error.strerror or error}") from error
    except ValueError as error:  # a null character, or a name that no file system can encode
        raise FileFormatError(path, f"not a valid file name: {error}") from error
    if not stat.S_ISREG(status.st_mode):
        kind = next((name for is_it, name in _KINDS if is_it(status.st_mode)), "something else")
        advice = (
            "pass the file itself, or one of the files in it"
            if kind == "a folder"
            else "copy its content to a file"
        )
        raise FileFormatError(path, f"cannot be opened: it is {kind}, not a file; {advice}")
    return status.st_size


def open_file(path: Path) -> io.BufferedReader:
    """Open a file for reading.

    Raises:
        FileFormatError: the path is not a regular file, or cannot be opened.
    """
    require_file(path)
    try:
        return path.open("rb")
    except OSError as error:
        raise FileFormatError(path, f"cannot be opened: {error.strerror or error}") from error


def file_bytes(path: Path, most_bytes: int | None = None) -> bytes:
    """The content of a file.

    Raises:
        FileFormatError: the file is missing, cannot be read, or is larger than `most_bytes`.
    """
    with open_file(path) as stream:
        try:
            if most_bytes is not None and stream.seek(0, io.SEEK_END) > most_bytes:
                raise FileFormatError(path, f"larger than {most_bytes} bytes")
            stream.seek(0)
            return stream.read()
        except (OSError, MemoryError) as error:
            problem = getattr(error, "strerror", None) or str(error) or "it does not fit into memory"
            raise FileFormatError(path, f"cannot be read: {problem}") from error


def file_text(path: Path, most_bytes: int | None = None) -> str:
    """The content of a file as UTF-8 text.

    Raises:
        FileFormatError: the file is missing, unreadable, larger than `most_bytes`, or not text.
    """
    try:
        return file_bytes(path, most_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(path, f"byte {error.start}: not UTF-8 text") from error


def read_json(path: Path, most_bytes: int = MOST_JSON_BYTES, *, allow_nan: bool = False) -> Any:
    """Parse a JSON file.

    Args:
        path: the file.
        most_bytes: the largest file size.
        allow_nan: whether to accept NaN and Infinity, which JSON does not have.

    Raises:
        FileFormatError: the file is missing, too large, nested too deeply, or not JSON.
    """
    return json_values(path, file_text(path, most_bytes), allow_nan=allow_nan)


def problem_of_name(name: object) -> str | None:
    """Why a file's image name is invalid; None if it is valid."""
    if not isinstance(name, str):
        return f"a name must be text, got {type(name).__name__}"
    if not name:
        return "a name is empty"
    if any(mark in name for mark in "\0\r\n"):
        return f"the name {name[:60]!r} contains a null character or a line break"
    try:
        size = len(name.encode())
    except UnicodeEncodeError:
        return f"the name {name[:60]!r} is not Unicode text"
    return f"a name has {size} bytes, more than {_MOST_NAME_BYTES}" if size > _MOST_NAME_BYTES else None
