"""The folder of one reconstruction: what stands where, and whose it is."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epipole.errors import WorkspaceError
from epipole.io.atomic import atomic_write

MARK = "epipole.json"
FORMAT = 1


@dataclass(frozen=True, slots=True)
class Workspace:
    """Paths inside the output folder."""

    root: Path

    @property
    def units(self) -> Path:
        """Files of the units of work; may be deleted when the model is done."""
        return self.root / "work"

    @property
    def database(self) -> Path:
        """COLMAP database: features, matches, two-view geometries."""
        return self.root / "database.db"

    @property
    def sparse(self) -> Path:
        """COLMAP models: 0 is the largest."""
        return self.root / "sparse"

    @property
    def images(self) -> Path:
        """The pictures as the model sees them: turned upright."""
        return self.root / "images"

    @property
    def frames(self) -> Path:
        """Frames taken from a video."""
        return self.root / "work" / "frames"


def open_workspace(root: Path, source: str) -> Workspace:
    """Make the output folder, or open it again if it belongs to the same pictures.

    Raises:
        WorkspaceError: it is a file, holds something else or other pictures, or is not writable.
    """
    mark = root / MARK
    try:
        if root.exists() and not root.is_dir():
            raise WorkspaceError(f"{root} is a file; the output must be a folder")
        if mark.is_file():
            _check_mark(root, mark, source)
        elif root.is_dir() and any(p for p in root.iterdir() if not p.name.startswith(".")):
            raise WorkspaceError(
                f"{root} is not empty and was not made by epipole; choose another output folder"
            )
        root.mkdir(parents=True, exist_ok=True)
        if not os.access(root, os.W_OK):
            raise WorkspaceError(f"{root} is not writable")
    except OSError as error:
        if isinstance(error, WorkspaceError):
            raise
        raise WorkspaceError(f"cannot use {root} as output folder: {error.strerror or error}") from error
    write_json(mark, {"format": FORMAT, "source": source})
    return Workspace(root)


def _check_mark(root: Path, mark: Path, source: str) -> None:
    try:
        content = json.loads(mark.read_text())
        held = str(content["source"])
    except (ValueError, KeyError, TypeError):
        raise WorkspaceError(f"{mark} is damaged; delete {root} or choose another output folder") from None
    if held != source and any(p for p in root.iterdir() if p.name != MARK):  # a mark alone holds nothing
        raise WorkspaceError(f"{root} holds the reconstruction of {held}; choose another output folder")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON, aside and renamed."""
    with atomic_write(path) as aside:
        aside.write_text(json.dumps(content, indent=2, default=str) + "\n")
