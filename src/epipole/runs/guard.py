"""What a command may write: what does not exist, what an earlier run of its kind has written, or anything with --overwrite.

An output folder proves by its mark (`folder.py`) what is ours; a single file (a video, a mesh, a page) by the seal in it
(`io/seals.py`). A name or a format is no proof, and a file that was changed since it was written counts as the user's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from epipole.errors import WorkspaceError
from epipole.io.atomic import atomic_write, is_stream, remove_abandoned_parts, reporting
from epipole.io.seals import add_seal, sealed_by

_OVERWRITES: ContextVar[bool] = ContextVar("overwrites", default=False)


@contextmanager
def overwriting() -> Iterator[None]:
    """In the block existing files of the user may be replaced, as `--overwrite` asks; inputs never are."""
    token = _OVERWRITES.set(True)
    try:
        yield
    finally:
        _OVERWRITES.reset(token)


def is_overwriting() -> bool:
    """Whether the user asked for existing files to be replaced."""
    return _OVERWRITES.get()


def refuse_existing(targets: Sequence[Path], kind: str, inputs: Sequence[Path]) -> None:
    """Before any work: each target is new, or an unchanged file that an earlier `kind` wrote, or may be overwritten.

    Args:
        targets: files that will be written.
        kind: the command.
        inputs: files and folders that it reads; these are never replaced, whatever was asked.

    Raises:
        WorkspaceError: a target exists and is not ours, is an input, or is no file.
    """
    for target in targets:
        with reporting(target):
            if is_stream(target) or not target.exists():
                continue
            real = target.resolve()
            if any(path.exists() and real.samefile(path) for path in inputs):
                raise WorkspaceError(f"{target} is what epipole {kind} reads: give another name")
            if sealed_by(real) == kind:
                continue
            if not is_overwriting():
                raise WorkspaceError(
                    f"{target} already exists and was not written by epipole {kind}, or has changed since: "
                    "give another name, or pass --overwrite to replace it"
                )
            below = [path for path in inputs if path.is_dir() and real.is_relative_to(path.resolve())]
            if below:
                raise WorkspaceError(f"{target} is a file of {below[0]}, which is read: give another name")


@contextmanager
def replacing_file(target: Path, kind: str, inputs: Sequence[Path]) -> Iterator[Path]:
    """Yield a path beside the target; when the block ends, what it wrote there is sealed and replaces the target.

    Args:
        target: the file; devices and pipes are written to, links followed.
        kind: the command.
        inputs: files and folders that it reads.

    Raises:
        WorkspaceError: see `refuse_existing`; or the file cannot be written.
    """
    refuse_existing([target], kind, inputs)
    remove_abandoned_parts(target.resolve().parent)
    with atomic_write(target) as part:
        try:
            yield part
            add_seal(part, kind)
        except WorkspaceError as error:  # users know the target, not the file beside it
            raise WorkspaceError(str(error).replace(str(part), str(target))) from error
        refuse_existing([target], kind, inputs)  # somebody may have written it meanwhile
