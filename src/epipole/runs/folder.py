"""The output folder of a run: which job made it, and which of its files earlier runs have written.

A file, `epipole.json`, marks it: the job, what the results were made from, the version, and every result that
was ever written. A non-empty folder without the mark is refused, and no file is overwritten or removed that
no earlier run has written.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from epipole._version import __version__
from epipole.errors import WorkspaceError
from epipole.io.atomic import atomic_write, reporting
from epipole.io.files import read_json

MARK = "epipole.json"
FORMAT = 2


class OutputFolder:
    """An output folder that belongs to one job on one source. Made by `claim`.

    Attributes:
        root: the folder.
        kind: the command: reconstruct, stereo, ...
        source: what its contents are made from.
        files: names of the results, by group; relative, with slashes.
        finished: digest of the settings of the finished run; empty until it finishes.
        timings_s: seconds of each stage.
    """

    def __init__(self, root: Path, kind: str, source: str) -> None:
        self.root, self.kind, self.source = root, kind, source
        self.files: dict[str, list[str]] = {}
        self.finished = ""
        self.timings_s: dict[str, float] = {}

    @contextmanager
    def publish(self, group: str) -> Iterator[Path]:
        """Yield an empty folder whose contents replace the group's earlier files when the block ends.

        Each file appears in one step, and those of an earlier run that this one does not have are removed. If the block
        raises, all is as it was.

        Raises:
            WorkspaceError: the disk is full, or a file of that name exists that no run has written.
        """
        aside = self.root / f".{group}.{secrets.token_hex(4)}.part"
        with reporting(self.root):
            try:
                aside.mkdir()
                yield aside
                new = sorted(p.relative_to(aside).as_posix() for p in aside.rglob("*") if p.is_file())
                with self.replacing(group, new):
                    for name in new:
                        target = self.root / name
                        target.parent.mkdir(parents=True, exist_ok=True)
                        (aside / name).replace(target)
            finally:
                shutil.rmtree(aside, ignore_errors=True)

    @contextmanager
    def replacing(self, group: str, names: Sequence[str]) -> Iterator[None]:
        """Record single files in the mark before they are written, and remove stale ones after.

        Raises:
            WorkspaceError: a file of that name exists that no run has written.
        """
        ours = {name for of_group in self.files.values() for name in of_group}
        for name in names:
            if os.path.lexists(self.root / name) and name not in ours:
                raise WorkspaceError(
                    f"{self.root} holds {name}, which no earlier run has written: choose another folder"
                )
        before = self.files.get(group, [])
        self.files[group] = sorted({*before, *names})
        self.save()
        yield
        self._remove(set(before) - set(names))
        self.files[group] = sorted(names)
        self.save()

    def write_text(self, name: str, text: str) -> None:
        """Write one text file of the results."""
        with self.publish(name) as aside:
            (aside / name).write_text(text, encoding="utf-8")

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write one JSON file of the results."""
        self.write_text(name, json.dumps(content, indent=2, default=str) + "\n")

    def give_up(self) -> None:
        """Remove mark and folder of a run that failed before it wrote any result."""
        if not self.files and [path.name for path in self.root.iterdir()] == [MARK]:
            (self.root / MARK).unlink()
            self.root.rmdir()

    def save(self) -> None:
        """Write the mark."""
        content = {
            "format": FORMAT,
            "kind": self.kind,
            "source": self.source,
            "version": __version__,
            "finished": self.finished,
            "timings_s": self.timings_s,
            "files": self.files,
        }
        with atomic_write(self.root / MARK) as aside:
            aside.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")

    def _remove(self, names: Iterable[str]) -> None:
        for name in names:
            path = self.root / name
            path.unlink(missing_ok=True)
            folder = path.parent
            while folder != self.root and folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
                folder = folder.parent


def claim(root: Path, kind: str, source: str, inputs: Sequence[Path] = ()) -> OutputFolder:
    """Make the output folder, or open it again if it belongs to the same job on the same source.

    Args:
        root: the folder.
        kind: the command that makes its contents.
        source: what they are made from, in words or paths; a folder that holds results of another is refused.
        inputs: files and folders that are read; none of them may be the output folder.

    Raises:
        WorkspaceError: it is a file, holds something else, or is not writable.
    """
    with reporting(root, "use the output folder"):
        if root.exists() and not root.is_dir():
            raise WorkspaceError(f"{root} is a file; the output must be a folder")
        for path in inputs:
            if root.resolve() == (path.resolve() if path.is_dir() else path.resolve().parent):
                what = "the pictures" if path.is_dir() else path.name
                raise WorkspaceError(f"{root} is the folder of {what}: choose another for the results")
        held = read_mark(root)
        if held is None and root.is_dir() and any(not p.name.startswith(".") for p in root.iterdir()):
            raise WorkspaceError(
                f"{root} is not empty and was not made by epipole; choose another output folder"
            )
        if held is not None and held.files and (held.kind, held.source) != (kind, source):
            raise WorkspaceError(
                f"{root} holds the results of `epipole {held.kind}` of {held.source}; choose another output folder"
            )
        root.mkdir(parents=True, exist_ok=True)
        if not os.access(root, os.W_OK):
            raise WorkspaceError(f"{root} is not writable")
        is_same = held is not None and (held.kind, held.source) == (kind, source)
        folder = held if held is not None and is_same else OutputFolder(root, kind, source)
        folder.save()
        return folder


def read_mark(root: Path) -> OutputFolder | None:
    """What the mark of a folder says; None for a folder without one.

    Raises:
        WorkspaceError: it is damaged, or of another version's format.
    """
    mark = root / MARK
    if not mark.is_file():
        return None
    try:
        content = read_json(mark)
        number, files, timings = content["format"], content.get("files", {}), content.get("timings_s", {})
        if number == FORMAT:
            folder = OutputFolder(root, str(content["kind"]), str(content["source"]))
            folder.files = {str(group): [str(name) for name in names] for group, names in files.items()}
            folder.finished = str(content["finished"])
            folder.timings_s = {str(stage): float(seconds) for stage, seconds in timings.items()}
            return folder
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise WorkspaceError(f"{mark} is damaged; delete {root} or choose another output folder") from None
    raise WorkspaceError(f"{root} was made by another version of epipole; choose another output folder")
