"""What the results of a run are made from: known again when it was renamed, and a few of its files have changed.

Which files there are, by names and sizes, is kept as a sketch: the smallest of the digests of all of them. Two sketches
tell which part of both sets is common (Broder, On the resemblance and containment of documents, 1997, section 2).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from epipole.runs.units import digest

MOST_FILES = 100_000
"""Folders with more are known by their paths alone."""
FINGERPRINT = 64
"""Digests kept of a source: all, where it has fewer files."""
SAME = 0.5
"""Two sources are the same where this part of their files is."""


@dataclass(frozen=True, slots=True)
class Source:
    """Files and folders that are read: their absolute paths, and a sketch of what is there."""

    paths: tuple[str, ...]
    fingerprint: tuple[str, ...] = ()
    """Of the names and sizes of all files; empty where there are none or too many."""

    @classmethod
    def of(cls, inputs: Sequence[Path], ignored: Path) -> Source:
        """The source that these files and folders are now.

        Args:
            inputs: files and folders.
            ignored: a folder that is left out, as it may lie among the images.
        """
        return cls(tuple(str(path.resolve()) for path in inputs), _fingerprint(inputs, ignored.resolve()))

    def __str__(self) -> str:
        return ", ".join(self.paths)

    def is_gone(self) -> bool:
        """Whether nothing is at its paths any more."""
        return not any(Path(path).exists() for path in self.paths)

    def is_same_as(self, other: Source) -> bool:
        """Whether the paths are the same, or nothing is at these and mostly the same files are at the other's."""
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
