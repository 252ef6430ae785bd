"""The kind of job that an output folder belongs to."""

from __future__ import annotations

from pathlib import Path

from epipole._checks import checked
from epipole.errors import WorkspaceError
from epipole.runs.folder import read_mark


@checked
def is_output_of(path: Path, kind: str) -> bool:
    """Whether a path is an output folder of a job of this kind, by its marker; false if the marker is damaged."""
    try:
        mark = read_mark(path) if path.is_dir() else None
    except WorkspaceError:
        return False
    return mark is not None and mark.kind == kind
