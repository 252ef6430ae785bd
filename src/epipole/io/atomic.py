"""Atomic writing: a file or folder is either complete or absent."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import socket
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from hashlib import blake2b
from pathlib import Path

from epipole.errors import EpipoleError, WorkspaceError

_PART = re.compile(
    r"\.epipole-(?P<machine>[0-9a-f]{8})-(?P<process>\d{1,10})-(?P<life>[0-9a-f]{8})[0-9a-f]{8}\.part(\..*)?",
    re.DOTALL,
)
_LIFE = secrets.token_hex(4)
"""Identifies this process: process numbers are reused."""
_LONGEST_SUFFIX = 32


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; its content replaces `path` when the block ends.

    The temporary name keeps the suffix, since some writers choose the format by it. If the block raises, `path` stays
    unchanged. Missing parent folders are created; a symbolic link is resolved, not replaced. Only regular files are
    replaced; devices and pipes (`/dev/null`, `/dev/stdout`) are written to.

    Raises:
        WorkspaceError: the path is not writable, the disk is full, or the path is a folder or a socket.
    """
    with reporting(path):
        if is_stream(Path(path)):
            with tempfile.TemporaryDirectory(prefix="epipole-") as folder:
                part = part_beside(Path(folder) / Path(path).name)
                yield part
                _pour(part, Path(path))
            return
        target = Path(path).resolve()
        part = part_beside(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield part
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path, stale: Sequence[str] = ()) -> Iterator[Path]:
    """Yield a temporary empty folder; its files move into the folder `path` when the block ends.

    A new folder appears in one step. In an existing folder, files are replaced one at a time, each atomically. Other
    files stay, since they may be the user's; only those named in `stale` are removed.

    Raises:
        WorkspaceError: the path is not writable, the disk is full, `path` is a file, or a new file has the name of
            an existing folder, device, pipe or socket.
    """
    target = Path(path).resolve()
    if target.exists() and not target.is_dir():
        raise WorkspaceError(f"cannot write the folder {path}: a file with this name exists")
    exists = target.is_dir()
    # Inside an existing folder: its parent may be read-only, or on another disk.
    part = part_beside(target / "folder" if exists else target)
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


def part_beside(target: Path) -> Path:
    """A new temporary path in the target's folder; its name identifies the process and keeps a short suffix."""
    endings = (
        "".join(target.suffixes[-2:]),
        target.suffix,
        "",
    )  # .compressed.ply is not the same format as .ply
    suffix = next(ending for ending in endings if len(os.fsencode(ending)) <= _LONGEST_SUFFIX)
    own = f".epipole-{_machine()}-{os.getpid()}-{_LIFE}{secrets.token_hex(4)}.part"
    return target.with_name(own + suffix)


def remove_abandoned_parts(folder: Path) -> None:
    """Remove partial files in a folder left by killed processes of this machine."""
    with suppress(OSError):
        for path in [path for path in folder.iterdir() if _is_abandoned(path.name)]:
            _remove(path)


def remove_abandoned_parts_below(root: Path) -> None:
    """Remove partial files in a folder and all folders below it."""
    for here, folders, files in os.walk(root):
        for name in filter(_is_abandoned, [*folders, *files]):
            _remove(Path(here) / name)
        folders[:] = [name for name in folders if not _is_abandoned(name)]


def _remove(part: Path) -> None:
    if part.is_dir() and not part.is_symlink():
        shutil.rmtree(part, ignore_errors=True)
    else:
        with suppress(OSError):
            part.unlink()


def _is_abandoned(name: str) -> bool:
    found = _PART.fullmatch(name)
    return (
        found is not None
        and found["machine"] == _machine()
        and not _is_alive(found["process"], found["life"])
    )


def _machine() -> str:
    return blake2b(socket.gethostname().encode(), digest_size=4).hexdigest()


def _is_alive(process: str, life: str) -> bool:
    """Whether the process with this number and token may still run."""
    if int(process) == os.getpid():
        return life == _LIFE
    if os.name == "nt":  # os.kill would end the process
        return True
    try:
        os.kill(int(process), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def is_stream(path: Path) -> bool:
    """Whether the path is a device or a pipe, which is written to instead of being replaced.

    Raises:
        WorkspaceError: the path is a folder, a socket or a disk.
        OSError: the path cannot be examined.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return False
    if stat.S_ISCHR(mode) or stat.S_ISFIFO(mode):
        return True
    if not stat.S_ISREG(mode):
        raise WorkspaceError(
            f"cannot write {path}: it is {'a folder' if stat.S_ISDIR(mode) else 'not a file'}"
        )
    return False


def _pour(source: Path, stream: Path) -> None:
    """Copy a file into a device or a pipe; a pipe without a reader raises an error instead of blocking."""
    opened = os.open(stream, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
    with source.open("rb") as content, os.fdopen(opened, "wb") as out:
        os.set_blocking(opened, True)
        shutil.copyfileobj(content, out)


def _move_files(source: Path, target: Path, stale: Sequence[str]) -> None:
    moved = set()
    files = sorted(p for p in source.rglob("*") if p.is_file())
    for file in files:
        refuse_other_kinds(target / file.relative_to(source))
    for file in files:
        name = file.relative_to(source)
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        file.replace(target / name)
        moved.add(name.as_posix())
    for old in set(stale) - moved:
        if (target / old).is_file():
            (target / old).unlink(missing_ok=True)


def refuse_other_kinds(path: Path) -> None:
    """Check that a path may be replaced: it is a file, a link to one, or does not exist.

    Raises:
        WorkspaceError: the path is a folder, a device, a pipe or a socket.
    """
    if os.path.lexists(path) and path.exists() and not path.is_file():
        raise WorkspaceError(f"cannot write {path}: it is {'a folder' if path.is_dir() else 'not a file'}")


@contextmanager
def reporting(path: str | Path, what: str = "write") -> Iterator[None]:
    """Convert an OSError into a one-line `cannot write PATH: reason`.

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
