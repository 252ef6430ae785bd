"""Units of work: each makes one file from its inputs, and is skipped when that file is already there.

A unit's key is a digest of everything its result depends on. The file keeps the key inside, is written aside
and renamed, so that a killed run leaves whole files only, and a changed option redoes only what depends on it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np

from epipole import _parallel
from epipole.errors import WorkspaceError
from epipole.workflow.progress import Progress, ProgressCallback, ignore_progress

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True, slots=True)
class Unit:
    """One piece of work: path = store(work(payload)), to be done unless the file holds this key."""

    path: Path
    key: str
    work: Callable[[Any], Arrays]
    """A module-level function, so that another process can call it."""
    payload: Any


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


def run_units(
    units: Sequence[Unit],
    *,
    stage: str,
    executor: Literal["inline", "threads", "processes"] = "threads",
    progress: ProgressCallback = ignore_progress,
) -> int:
    """Do the units whose files are missing or stale; returns how many were done.

    An error or an interrupt stops handing out units, lets the running ones finish, and is raised.

    Raises:
        WorkspaceError: a result cannot be written.
    """
    waiting = [unit for unit in units if stored_key(unit.path) != unit.key]
    done, total = len(units) - len(waiting), len(units)
    progress(Progress(stage, done, total))
    if executor == "inline" or len(waiting) <= 1 or _parallel.num_threads() == 1:
        for unit in waiting:
            _do(unit)
            done += 1
            progress(Progress(stage, done, total))
        return len(waiting)
    with _pool(executor) as pool:
        futures = [pool.submit(_do, unit) for unit in waiting]
        try:
            for future in as_completed(futures):
                future.result()
                done += 1
                progress(Progress(stage, done, total))
        except BrokenProcessPool as error:
            raise WorkspaceError(
                "the processes that share the work ended early: out of memory, or a script that starts them "
                "outside `if __name__ == '__main__':`"
            ) from error
        except BaseException:
            for future in futures:
                future.cancel()
            raise
    return len(waiting)


def _pool(executor: str) -> Executor:
    count = _parallel.num_threads()
    if executor == "processes":
        return ProcessPoolExecutor(count, mp_context=get_context("spawn"))
    return ThreadPoolExecutor(count, thread_name_prefix="epipole-unit", initializer=_parallel.run_inline_here)


def _do(unit: Unit) -> None:
    store(unit.path, unit.key, unit.work(unit.payload))


def store(path: Path, key: str, arrays: Arrays) -> None:
    """Write arrays and their key to one file, aside and renamed.

    Raises:
        WorkspaceError: the folder is not writable or the disk is full.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with aside.open("wb") as file:
            np.savez(file, key=np.array(key), **arrays)  # type: ignore[arg-type]
        aside.replace(path)
    except OSError as error:
        with suppress(OSError):
            aside.unlink()
        raise WorkspaceError(f"cannot write {path}: {error.strerror or error}") from error


def load(path: Path, *names: str) -> Arrays:
    """Read the arrays of these names from a unit's file; all of them if none is named."""
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in names or file.files if name != "key"}


def stored_key(path: Path) -> str:
    """The key inside a unit's file; empty if the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return str(file["key"])
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return ""
