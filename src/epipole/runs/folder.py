"""The output folder of a run: which job owns it, and which of its files were written by earlier runs.

A marker file, `epipole.json`, records the job, the source of the results, the version, and every result ever written. A
non-empty folder without this marker is rejected, and files not written by an earlier run are never overwritten or
removed.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from epipole._version import __version__
from epipole.errors import FileFormatError, WorkspaceError
from epipole.io.atomic import atomic_write, part_beside, remove_abandoned_parts_below, reporting
from epipole.io.contents_in_words import MARK as MARK
from epipole.io.files import read_json
from epipole.io.json_files import json_text
from epipole.io.names import is_inside_name, path_inside
from epipole.runs.guard import is_overwriting
from epipole.runs.lock import LOCK, remove_free_locks
from epipole.runs.marks import inside_name_of_mark, texts_of_mark
from epipole.runs.source import Source

FORMAT = 3
FILE_SUFFIXES = frozenset(
    [
        ".mp4",
        ".mov",
        ".avi",
        ".mkv",
        ".webm",
        ".m4v",
        ".mpg",
        ".mpeg",
        ".wmv",
        ".gif",
        ".jpg",
        ".jpeg",
        ".png",
        ".tif",
        ".tiff",
        ".webp",
        ".bmp",
        ".heic",
        ".exr",
        ".pfm",
        ".ply",
        ".obj",
        ".glb",
        ".gltf",
        ".stl",
        ".spz",
        ".sog",
        ".splat",
        ".npz",
        ".npy",
        ".json",
        ".yaml",
        ".yml",
        ".txt",
        ".csv",
        ".html",
        ".htm",
        ".pdf",
        ".xml",
        ".zip",
        ".tar",
        ".gz",
        ".bz2",
        ".7z",
        ".bin",
        ".db",
        ".out",
        ".bag",
        ".db3",
        ".mcap",
        ".py",
        ".md",
    ]
)
"""A missing folder is not created under a name with one of these suffixes: a file was probably intended."""


class OutputFolder:
    """An output folder that belongs to one job on one source. Created by `claim`.

    Attributes:
        root: the folder.
        kind: the command: reconstruct, stereo, ...
        source: the inputs of its results.
        files: relative names of the results, with slashes, by group.
        finished: digest of the settings of the finished run; empty until it finishes.
        has_failed: whether the last run ended in an error, and no earlier run produced a result.
        timings_s: seconds per stage.
    """

    def __init__(self, root: Path, kind: str, source: Source) -> None:
        self.root, self.kind, self.source = root, kind, source
        self.files: dict[str, list[str]] = {}
        self.finished = ""
        self.has_failed = False
        self.timings_s: dict[str, float] = {}

    @contextmanager
    def publish(self, group: str) -> Iterator[Path]:
        """Yield an empty folder whose contents replace the group's earlier files when the block ends.

        Each file is replaced atomically, and files of an earlier run that this one does not write are removed. If the
        block raises, nothing changes.

        Raises:
            WorkspaceError: the disk is full, or a file of that name exists that was not written by an earlier run.
        """
        aside = part_beside(self.root / group)
        with reporting(self.root, "write to the folder"):
            try:
                aside.mkdir()
                yield aside
                new = sorted(p.relative_to(aside).as_posix() for p in aside.rglob("*") if p.is_file())
                with self.replacing(group, new):
                    for name in new:
                        target = self.root / name
                        target.parent.mkdir(parents=True, exist_ok=True)
                        (aside / name).replace(target)
            except WorkspaceError as error:
                raise WorkspaceError(str(error).replace(str(aside), str(self.root))) from error
            finally:
                shutil.rmtree(aside, ignore_errors=True)

    @contextmanager
    def replacing(self, group: str, names: Sequence[str]) -> Iterator[None]:
        """Record files in the marker before they are written, and remove stale ones afterwards.

        Raises:
            WorkspaceError: a name leads out of the folder, or exists but was not written by an earlier run.
        """
        self._refuse_what_is_not_ours(names)
        before = self.files.get(group, [])
        self.files[group] = sorted({*before, *names})
        self.save()
        yield
        self._remove(set(before) - set(names))
        self.files[group] = sorted(names)
        self.save()

    def write_text(self, name: str, text: str) -> None:
        """Write a text file to the results."""
        with self.publish(name) as aside:
            (aside / name).write_text(text, encoding="utf-8")

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a JSON file to the results; numbers that are not finite become null."""
        self.write_text(name, json_text(content))

    def give_up(self, *, has_failed: bool) -> None:
        """Clean up after a run that ended early: remove marker and log if nothing else is there, else record a failure."""
        left = {path.name for path in self.root.iterdir()} - {MARK, LOCK, *self.files.get("log", ())}
        if not left and set(self.files) <= {"log"}:
            self._remove(self.files.pop("log", ()))
            (self.root / MARK).unlink()
        else:
            self.has_failed = has_failed and set(self.files) <= BY_PRODUCTS

    def refuse_replaced(self) -> None:
        """Check before any work that everything written by an earlier run is still a file, and so can be replaced.

        Raises:
            WorkspaceError: a result was replaced with a folder or a link.
        """
        self._refuse_what_is_not_ours(
            [name for names in self.files.values() for name in names if is_inside_name(name)]
        )

    def save(self) -> None:
        """Write the marker file."""
        content = {
            "format": FORMAT,
            "kind": self.kind,
            "source": self.source.paths,
            "sketch": self.source.fingerprint,
            "version": __version__,
            "finished": self.finished,
            "has_failed": self.has_failed,
            "timings_s": self.timings_s,
            "files": self.files,
        }
        with atomic_write(self.root / MARK) as aside:
            aside.write_text(json_text(content, indent=1), encoding="utf-8")

    def take_over(self, kind: str, source: Source) -> OutputFolder:
        """Hand the folder over to another job, after removing the results of this one."""
        for names in self.files.values():
            self._remove(names)
        return OutputFolder(self.root, kind, source)

    def _refuse_what_is_not_ours(self, names: Sequence[str]) -> None:
        ours = {name for of_group in self.files.values() for name in of_group}
        parents = set()
        for name in names:
            parent = name.rpartition("/")[0]
            if parent not in parents or not is_inside_name(name):
                try:
                    path_inside(self.root, name)
                except FileFormatError as error:
                    raise WorkspaceError(str(error)) from None
                parents.add(parent)
            with suppress(FileNotFoundError):
                is_file = stat.S_ISREG((self.root / name).lstat().st_mode)
                if name in ours and not is_file:
                    raise WorkspaceError(
                        f"{self.root / name} is no longer a file: remove it, or choose another folder"
                    )
                if name not in ours and not (is_file and is_overwriting() and not self._is_input(name)):
                    raise WorkspaceError(
                        f"{self.root} contains {name}, which was not written by an earlier run: choose another folder"
                    )

    def _is_input(self, name: str) -> bool:
        real = (self.root / name).resolve()
        return any(real.is_relative_to(path) for path in self.source.paths)

    def _remove(self, names: Iterable[str]) -> None:
        """Remove results and the folders that this leaves empty; results replaced with other things than files stay."""
        for name in names:
            try:
                path = path_inside(self.root, name)
                if stat.S_ISREG(path.lstat().st_mode):
                    path.unlink()
            except (FileNotFoundError, FileFormatError):
                continue
            folder = path.parent
            while folder != self.root and folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
                folder = folder.parent


BY_PRODUCTS = frozenset({"database", "log"})
"""Groups written before it is known whether there will be a result."""


def check_output_path(root: Path, kind: str, inputs: Sequence[Path]) -> None:
    """Check before any work, without changing anything, that the output folder is new, ours, or may be overwritten.

    Args:
        root: the folder.
        kind: the command that writes it.
        inputs: files and folders that are read; none of them may be the output folder.

    Raises:
        WorkspaceError: the path is a file, the folder of the inputs, or has other contents.
    """
    with reporting(root, "use the output folder"):
        if root.exists() and not root.is_dir():
            raise WorkspaceError(f"{root} is a file; the output must be a folder")
        is_ours = (root.parent / MARK).is_file()  # for example, a pair's folder, named after its image
        if not root.exists() and root.suffix.lower() in FILE_SUFFIXES and not is_ours:
            raise WorkspaceError(
                f"`epipole {kind}` writes a folder, but {root} has the name of a {root.suffix} file: "
                "pass the name of a folder"
            )
    refuse_folder_of(root, inputs)
    _existing(root, kind, Source.of(inputs, root))


def refuse_folder_of(root: Path, inputs: Sequence[Path]) -> None:
    """Reject the folder of the inputs as the output folder.

    Raises:
        WorkspaceError: `root` is the folder of an input.
    """
    with reporting(root, "use the output folder"):
        for path in inputs:
            if root.resolve() == (path.resolve() if path.is_dir() else path.resolve().parent):
                what = "the images" if path.is_dir() else path.name
                raise WorkspaceError(f"{root} is the folder of {what}: choose another output folder")


def claim(root: Path, kind: str, inputs: Sequence[Path]) -> OutputFolder:
    """Create the output folder, or reopen it if it belongs to the same job on the same source.

    The source is the same if its paths are, or if nothing exists at the old paths and most files at the new ones match.
    A folder whose run failed may be taken over by any job. With `overwriting`, so may any folder; in a folder without a
    marker, only files that have the names of results are replaced.

    Args:
        root: the folder.
        kind: the command that writes it.
        inputs: files and folders that are read; none of them may be the output folder.

    Raises:
        WorkspaceError: the path is a file, has other contents, or is not writable.
    """
    check_output_path(root, kind, inputs)
    source = Source.of(inputs, root)
    with reporting(root, "use the output folder"):
        found = _existing(root, kind, source)
        root.mkdir(parents=True, exist_ok=True)
        if not os.access(root, os.W_OK):
            raise WorkspaceError(f"{root} is not writable")
        if found is None:
            folder = OutputFolder(root, kind, source)
        elif found.kind == kind and found.source.is_same_as(source):
            folder = found
            folder.source = source
            folder.refuse_replaced()
        else:
            folder = found.take_over(kind, source)
        remove_abandoned_parts_below(root)
        remove_free_locks(root)
        folder.save()
        return folder


def _existing(root: Path, kind: str, source: Source) -> OutputFolder | None:
    """The folder's current owner; None if it is new.

    Raises:
        WorkspaceError: the folder is not ours, or belongs to another job or source that has results.
    """
    with reporting(root, "use the output folder"):
        found = read_mark(root)
        if is_overwriting():
            return found
        if found is None:
            if root.is_dir() and any(not p.name.startswith(".") for p in root.iterdir()):
                raise WorkspaceError(
                    f"{root} is not empty and was not written by epipole; choose another output folder, or pass "
                    "--overwrite to replace files that have the names of results"
                )
            return None
        is_same = found.kind == kind and found.source.is_same_as(source)
        if not (is_same or found.has_failed or _is_bare(root, found)):
            raise WorkspaceError(_whose(found))
        return found


def _is_bare(root: Path, found: OutputFolder) -> bool:
    log = found.files.get("log", ())
    return set(found.files) <= {"log"} and {path.name for path in root.iterdir()} <= {MARK, LOCK, *log}


def _whose(found: OutputFolder) -> str:
    what = "results" if set(found.files) - BY_PRODUCTS else "intermediate files"
    back = (
        ", or, if these are the same files under a new name, rename them back"
        if found.source.is_gone()
        else ""
    )
    of = f"{found.root} contains the {what} of `epipole {found.kind}` for {found.source}"
    return f"{of}; choose another output folder, or pass --overwrite{back}"


MODEL_KINDS = frozenset(
    {"reconstruct", "slam", "undistort", "merge", "georeference"}
)  # their models describe upright images


def has_own_model(root: Path) -> bool:
    """Whether the model in a folder was made by epipole, according to its marker."""
    try:
        mark = read_mark(root)
    except WorkspaceError:
        return False
    return mark is not None and mark.kind in MODEL_KINDS


def read_mark(root: Path) -> OutputFolder | None:
    """Read the marker of a folder; None if it has none.

    Raises:
        WorkspaceError: the marker is damaged, or in another version's format.
    """
    mark = root / MARK
    if not mark.is_file():
        return None
    try:
        content = read_json(mark)
        number, files, timings = content["format"], content.get("files", {}), content.get("timings_s", {})
        if number == FORMAT:
            source = Source(texts_of_mark(content["source"]), texts_of_mark(content["sketch"]))
            folder = OutputFolder(root, str(content["kind"]), source)
            folder.files = {
                str(group): [inside_name_of_mark(name) for name in names] for group, names in files.items()
            }
            folder.finished = str(content["finished"])
            folder.has_failed = content.get("has_failed", False) is True
            folder.timings_s = {str(stage): float(seconds or 0.0) for stage, seconds in timings.items()}
            return folder
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError):
        raise WorkspaceError(f"{mark} is damaged; delete {root} or choose another output folder") from None
    raise WorkspaceError(f"{root} was made by another version of epipole; choose another output folder")
