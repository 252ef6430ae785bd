"""Files and folders that are either there whole or not at all."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from epipole.errors import EpipoleError, WorkspaceError


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; what is written there replaces `path` when the block ends.

    The temporary name keeps the suffix, since some writers choose the format by it. If the block raises,
    `path` is as it was. Missing parent folders are made; a link is followed, not replaced.

    Raises:
        WorkspaceError: the place is not writable, or full.
    """
    target = Path(path).resolve()
    part = _name_beside(target)
    with reporting(path):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield part
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path, stale: Sequence[str] = ()) -> Iterator[Path]:
    """Yield a temporary empty folder; what is written there becomes the folder `path` when the block ends.

    A new folder appears in one step. In a folder that exists each file is replaced in one step, one after the
    other, and other files stay, for they may be the user's; only those named in `stale` are removed.

    Raises:
        WorkspaceError: the place is not writable, or full, or `path` is a file.
    """
    target = Path(path).resolve()
    if target.exists() and not target.is_dir():
        raise WorkspaceError(f"cannot write the folder {path}: there is a file of this name")
    exists = target.is_dir()
    # Inside a folder that exists: its parent may be read-only, or another disk.
    part = _name_beside(target / "folder") if exists else _name_beside(target)
    with reporting(path):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.mkdir()
            yield part
            if exists:
                _move_files(part, target, stale)
            else:
                part.rename(target)
        finally:
            shutil.rmtree(part, ignore_errors=True)


def _name_beside(target: Path) -> Path:
    return target.with_name(f".{target.stem[:60]}.{secrets.token_hex(4)}.part{target.suffix}")


def _move_files(source: Path, target: Path, stale: Sequence[str]) -> None:
    moved = set()
    for file in sorted(p for p in source.rglob("*") if p.is_file()):
        name = file.relative_to(source)
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        file.replace(target / name)
        moved.add(name.as_posix())
    for old in set(stale) - moved:
        (target / old).unlink(missing_ok=True)


@contextmanager
def reporting(path: str | Path, what: str = "write") -> Iterator[None]:
    """Turn the system's errors into one clear line: cannot write PATH, and why.

    Raises:
        WorkspaceError: an OSError was raised inside.
    """
    try:
        yield
    except EpipoleError:
        raise
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        raise WorkspaceError(f"cannot {what} {path}: {reason}") from error
