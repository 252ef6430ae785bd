"""Files and folders that are either there whole or not at all."""

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
"""Of this process: another may have had its number."""
_LONGEST_SUFFIX = 32


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; what is written there replaces `path` when the block ends.

    The temporary name keeps the suffix, since some writers choose the format by it. If the block raises,
    `path` is as it was. Missing parent folders are made; a link is followed, not replaced. Only a regular file is
    replaced: to a device or a pipe (`/dev/null`, `/dev/stdout`) the content is written.

    Raises:
        WorkspaceError: the place is not writable, or full, or a folder or a socket.
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
    """Yield a temporary empty folder; what is written there becomes the folder `path` when the block ends.

    A new folder appears in one step. In a folder that exists each file is replaced in one step, one after the
    other, and other files stay, for they may be the user's; only those named in `stale` are removed.

    Raises:
        WorkspaceError: the place is not writable, or full, `path` is a file, or something in it that is no file
            has the name of a new one.
    """
    target = Path(path).resolve()
    if target.exists() and not target.is_dir():
        raise WorkspaceError(f"cannot write the folder {path}: there is a file of this name")
    exists = target.is_dir()
    # Inside a folder that exists: its parent may be read-only, or another disk.
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
    """A new temporary name in the target's folder: it tells whose it is, keeps the suffix, and is never long."""
    endings = (
        "".join(target.suffixes[-2:]),
        target.suffix,
        "",
    )  # .compressed.ply is another format than .ply
    suffix = next(ending for ending in endings if len(os.fsencode(ending)) <= _LONGEST_SUFFIX)
    own = f".epipole-{_machine()}-{os.getpid()}-{_LIFE}{secrets.token_hex(4)}.part"
    return target.with_name(own + suffix)


def remove_abandoned_parts(folder: Path) -> None:
    """Remove what processes of this machine that are gone (killed) have left half written in a folder."""
    with suppress(OSError):
        for path in [path for path in folder.iterdir() if _is_abandoned(path.name)]:
            _remove(path)


def remove_abandoned_parts_below(root: Path) -> None:
    """The same for a folder and all below it."""
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
    """Whether the process that had this number, and this token, may still run."""
    if int(process) == os.getpid():
        return life == _LIFE
    if os.name == "nt":  # there os.kill ends the process
        return True
    try:
        os.kill(int(process), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def is_stream(path: Path) -> bool:
    """Whether something stands there that is written to and not replaced.

    Raises:
        WorkspaceError: it is a folder, a socket or a disk.
        OSError: the system does not tell.
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
    """Write a file into a device or a pipe; a pipe that nobody reads is an error, where it would wait for ever."""
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
    """Refuse to replace what is neither a file nor a link to one.

    Raises:
        WorkspaceError: a folder, a device, a pipe or a socket stands there.
    """
    if os.path.lexists(path) and path.exists() and not path.is_file():
        raise WorkspaceError(f"cannot write {path}: it is {'a folder' if path.is_dir() else 'not a file'}")


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
