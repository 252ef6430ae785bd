"""The source of a run's results, recognized even if it was renamed and a few of its files have changed.

The set of files, by name and size, is stored as a sketch: the smallest of all their digests. Two sketches give the
fraction of files in common (Broder, On the resemblance and containment of documents, 1997, section 2).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from epipole.runs.units import digest

MOST_FILES = 100_000
"""Folders with more files are recognized only by their paths."""
FINGERPRINT = 64
"""Number of digests stored per source; all, if it has fewer files."""
SAME = 0.5
"""Two sources are the same if at least this fraction of their files is."""


@dataclass(frozen=True, slots=True)
class Source:
    """Files and folders that are read: their absolute paths, and a sketch of their contents."""

    paths: tuple[str, ...]
    fingerprint: tuple[str, ...] = ()
    """Digests of the names and sizes of files; empty if there are none or too many."""

    @classmethod
    def of(cls, inputs: Sequence[Path], ignored: Path) -> Source:
        """The current source given by these files and folders.

        Args:
            inputs: files and folders.
            ignored: a folder to skip, since it may be among the images.
        """
        return cls(tuple(str(path.resolve()) for path in inputs), _fingerprint(inputs, ignored.resolve()))

    def __str__(self) -> str:
        return ", ".join(self.paths)

    def is_gone(self) -> bool:
        """Whether none of its paths exists any more."""
        return not any(Path(path).exists() for path in self.paths)

    def is_same_as(self, other: Source) -> bool:
        """Whether the paths are the same, or nothing exists at these paths and most files at the other's match."""
        if self.paths == other.paths:
            return True
        union = sorted({*self.fingerprint, *other.fingerprint})[:FINGERPRINT]
        common = {*self.fingerprint} & {*other.fingerprint} & {*union}
        return bool(union) and len(common) >= SAME * len(union) and self.is_gone()


def _fingerprint(inputs: Sequence[Path], ignored: Path) -> tuple[str, ...]:
    found: set[str] = set()
    for number, path in enumerate(inputs):
        rows = _files_below(path, ignored) if path.is_dir() else _size_of(path)
        if rows is None:
            return ()
        found.update(digest(number, name, size)[:16] for name, size in rows)
    return tuple(sorted(found)[:FINGERPRINT])


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
