"""What the results of a run are made from: known again when it was renamed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from epipole.runs.units import digest

MOST_FILES = 100_000
"""Folders with more are known by their paths alone."""


def source_name(inputs: Sequence[Path]) -> str:
    """The paths, in words."""
    return ", ".join(str(path.resolve()) for path in inputs)


def content_digest(inputs: Sequence[Path], ignored: Path) -> str:
    """A digest of the names and sizes of all files of the inputs, empty where they hold none or too many.

    Args:
        inputs: files and folders.
        ignored: a folder that is left out, as it may lie among the pictures.
    """
    listed: list[list[tuple[str, int]]] = []
    for path in inputs:
        rows = _files_below(path, ignored.resolve()) if path.is_dir() else _size_of(path)
        if rows is None:
            return ""
        listed.append(rows)
    return digest(listed) if any(listed) else ""


def _size_of(path: Path) -> list[tuple[str, int]]:
    return [("", path.stat().st_size)] if path.is_file() else []


def _files_below(folder: Path, ignored: Path) -> list[tuple[str, int]] | None:
    rows: list[tuple[str, int]] = []
    for here, folders, files in os.walk(folder):
        at = Path(here)
        folders[:] = sorted(f for f in folders if not f.startswith(".") and (at / f).resolve() != ignored)
        for name in sorted(f for f in files if not f.startswith(".")):
            rows.append(((at / name).relative_to(folder).as_posix(), (at / name).lstat().st_size))
        if len(rows) > MOST_FILES:
            return None
    return rows
