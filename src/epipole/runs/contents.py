"""Digests of files, cached with size and modification time so that an unchanged file is not read again."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from epipole._checks.tables import TEXT, Expected
from epipole.errors import WorkspaceError
from epipole.io.files import open_file, require_file
from epipole.runs.executors import opened
from epipole.runs.progress import Progress, ProgressCallback, ignore_progress
from epipole.runs.units import is_done, load, store

_KEY = "contents 1"

_TABLE = {name: Expected(TEXT, "n") for name in ("paths", "states", "digests")}


def content_digests(
    paths: Iterable[Path], memory: Path, progress: ProgressCallback = ignore_progress
) -> dict[Path, str]:
    """The digest of each file's content.

    Args:
        paths: the files.
        memory: a cache file with the digests of the last call; created if missing, with its folder.
        progress: called after each file.

    Raises:
        FileFormatError: a file cannot be read.
        WorkspaceError: the cache cannot be written.
    """
    states = {path: _state_of(path) for path in paths}
    before = _remembered(memory)
    known = {
        path: before[str(path)][1]
        for path, state in states.items()
        if before.get(str(path), ("", ""))[0] == state
    }
    changed = [path for path in states if path not in known]
    with opened("threads" if len(changed) > 1 else "inline") as pool:
        progress(Progress("digest", 0, len(changed)))
        digests = (pool.map if isinstance(pool, Executor) else map)(_digest_of, changed)
        for n, (path, digest) in enumerate(zip(changed, digests), 1):
            known[path] = digest
            progress(Progress("digest", n, len(changed)))
    if changed or len(before) != len(states):
        rows = {"paths": [str(p) for p in states], "states": list(states.values())}
        rows["digests"] = [known[path] for path in states]
        store(memory, _KEY, {name: np.array(row, np.str_) for name, row in rows.items()})
    return {path: known[path] for path in states}


def _state_of(path: Path) -> str:
    num_bytes = require_file(path)
    return f"{num_bytes}-{path.stat().st_mtime_ns}"


def _remembered(memory: Path) -> dict[str, tuple[str, str]]:
    if not is_done(memory, _KEY):
        return {}
    try:
        table = load(memory, _TABLE)
    except WorkspaceError:
        return {}
    return {
        str(path): (str(state), str(digest))
        for path, state, digest in zip(table["paths"], table["states"], table["digests"])
    }


def _digest_of(path: Path) -> str:
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:32]
