"""What a command may write: new files, files written by an earlier run of the same command, or anything with --overwrite.

An output folder is recognized by its marker (`folder.py`), a single file (a video, a mesh, a page) by the seal inside
it (`io/seals.py`). Name and format prove nothing, and a file changed since it was written counts as the user's.
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
    """Allow replacing the user's files inside the block (`--overwrite`); inputs are never replaced."""
    token = _OVERWRITES.set(True)
    try:
        yield
    finally:
        _OVERWRITES.reset(token)


def is_overwriting() -> bool:
    """Whether the user asked to replace existing files."""
    return _OVERWRITES.get()


def refuse_existing(targets: Sequence[Path], kind: str, inputs: Sequence[Path]) -> None:
    """Check before any work that each target is new, an unchanged file written by `kind`, or may be overwritten.

    Args:
        targets: files that will be written.
        kind: the command.
        inputs: files and folders that it reads, which are never replaced.

    Raises:
        WorkspaceError: a target exists and is not ours, is an input, or is not a file.
    """
    for target in targets:
        with reporting(target):
            if is_stream(target) or not target.exists():
                continue
            real = target.resolve()
            if any(path.exists() and real.samefile(path) for path in inputs):
                raise WorkspaceError(f"{target} is an input of epipole {kind}: choose another name")
            if sealed_by(real) == kind:
                continue
            if not is_overwriting():
                raise WorkspaceError(
                    f"{target} already exists and was not written by epipole {kind}, or has changed since: "
                    "choose another name, or pass --overwrite to replace it"
                )
            below = [path for path in inputs if path.is_dir() and real.is_relative_to(path.resolve())]
            if below:
                raise WorkspaceError(f"{target} belongs to the input {below[0]}: choose another name")


@contextmanager
def replacing_file(target: Path, kind: str, inputs: Sequence[Path]) -> Iterator[Path]:
    """Yield a path beside the target; when the block ends, the file there is sealed and replaces the target.

    Args:
        target: the file; devices and pipes are written to, links resolved.
        kind: the command.
        inputs: files and folders that it reads.

    Raises:
        WorkspaceError: as in `refuse_existing`; or the file cannot be written.
    """
    refuse_existing([target], kind, inputs)
    remove_abandoned_parts(target.resolve().parent)
    with atomic_write(target) as part:
        try:
            yield part
            add_seal(part, kind)
        except WorkspaceError as error:  # users know the target, not the file beside it
            raise WorkspaceError(str(error).replace(str(part), str(target))) from error
        refuse_existing([target], kind, inputs)  # it may have been written in the meantime
