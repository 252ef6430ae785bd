"""Units of work: each writes one file from its inputs, and is skipped if that file already exists.

A unit's key is a digest of everything its result depends on. The file (an npz archive) contains the key, and ends with
a digest of its bytes. It is written under another name and then renamed. A killed run therefore leaves only complete
files, a changed option recomputes only what depends on it, and a damaged file is recomputed.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO
from zipfile import ZipFile

import numpy as np

from epipole import _parallel
from epipole._checks.tables import TEXT, Arrays, Expected, Table
from epipole.errors import FileFormatError, WorkspaceError
from epipole.io.array_files import checked_arrays, read_archive
from epipole.io.atomic import atomic_write
from epipole.io.files import open_file, require_file
from epipole.runs.threads import opencv_in_one_thread

_SEAL_BYTES = 16
_KEY = {"key": Expected(TEXT)}


@dataclass(frozen=True, slots=True)
class Unit:
    """A piece of work, path = store(work(payload)), to be done unless the file has this key."""

    path: Path
    key: str
    work: Callable[[Any], Arrays]
    """A module-level function, so that another process can call it."""
    payload: Any
    size: int = 1
    """Weight in the progress, such as the number of pairs in a block."""


def digest(*parts: object) -> str:
    """A short digest of JSON-like values and arrays, in order."""
    state = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, np.ndarray):
            state.update(f"{part.dtype}{part.shape}".encode())
            state.update(np.ascontiguousarray(part).tobytes())
        else:
            state.update(json.dumps(part, sort_keys=True, default=str).encode())
        state.update(b"\0")
    return state.hexdigest()


def remove_other_results(folder: Path, units: Sequence[Unit]) -> None:
    """Remove results in a folder that do not belong to these units, left by other options and inputs."""
    made = {unit.path.name for unit in units}
    for path in sorted(folder.glob("*.npz")):
        if path.name not in made and not path.is_symlink() and stored_key(path):
            path.unlink(missing_ok=True)


def do_unit(unit: Unit) -> int:
    """Run one unit and store its result; returns its size."""
    store(unit.path, unit.key, unit.work(unit.payload))
    return unit.size


def do_unit_as_worker(unit: Unit) -> int:
    """`do_unit` in a pool worker: nested parallel work runs inline, libraries use one thread."""
    with _parallel.inline_here(), opencv_in_one_thread(), _parallel.single_threaded_blas():
        return do_unit(unit)


def store(path: Path, key: str, arrays: Arrays) -> None:
    """Write arrays and their key to one file, under another name and then renamed.

    Raises:
        WorkspaceError: the folder is not writable or the disk is full.
    """
    with atomic_write(path) as aside:
        with aside.open("wb") as file:
            np.savez(file, key=np.array(key), **arrays)  # type: ignore[arg-type]
        with ZipFile(aside, "a") as archive:
            archive.comment = bytes(_SEAL_BYTES)  # stored at the end of the file
        with aside.open("r+b") as file:
            seal = _digest_of_file(file)
            file.seek(-_SEAL_BYTES, os.SEEK_END)
            file.write(seal)


def load(path: Path, table: Table, *names: str, **sizes: int) -> Arrays:
    """Read arrays from a unit's file.

    Args:
        path: the file.
        table: the expected arrays of such a file.
        names: arrays to read; all of the table if none is given.
        sizes: known lengths of the table's axes.

    Raises:
        WorkspaceError: the file is missing or damaged, or has other arrays.
    """
    wanted = {name: replace(table[name], is_optional=False) for name in names} if names else table
    try:
        found = _stored(path, table, *wanted)
        return checked_arrays(path, found, wanted, **sizes)
    except FileFormatError as error:
        problem = str(error).removeprefix(f"{path}: ")
        raise WorkspaceError(f"{path} is damaged ({problem}); delete it and run the command again") from error


def _stored(path: Path, table: Table, *names: str) -> Arrays:
    """Read arrays stored without compression: compressed ones can expand to gigabytes.

    Raises:
        FileFormatError: the file is missing or damaged, or larger when unpacked.
    """
    num_bytes = require_file(path)
    with open_file(path) as stream:
        return read_archive(path, stream, {**table, **_KEY}, num_bytes, names)


def is_done(path: Path, key: str) -> bool:
    """Whether a file has the result of this key, with every byte intact."""
    return stored_key(path) == key and _is_whole(path)


def stored_key(path: Path) -> str:
    """The key inside a unit's file; empty if the file is missing or damaged."""
    if not path.is_file():  # the usual case, without an error's search for similar names
        return ""
    try:
        with open_file(path) as stream:
            found = read_archive(path, stream, None, require_file(path), ["key"])
        return str(checked_arrays(path, found, _KEY)["key"])
    except FileFormatError:
        return ""


def _is_whole(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            seal = _digest_of_file(file)
            return file.read() == seal
    except OSError:
        return False


def _digest_of_file(file: BinaryIO) -> bytes:
    """Digest of all bytes before the seal; leaves the file position at the seal."""
    state = hashlib.blake2b(digest_size=_SEAL_BYTES)
    left = file.seek(0, os.SEEK_END) - _SEAL_BYTES
    file.seek(0)
    while left > 0 and (chunk := file.read(min(left, 1 << 20))):
        state.update(chunk)
        left -= len(chunk)
    return state.digest()
