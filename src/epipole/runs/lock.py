"""One run at a time in an output folder."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from epipole.errors import WorkspaceError
from epipole.io.atomic import reporting

if sys.platform == "win32":
    import msvcrt

    def _try_lock(file: int) -> None:
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _try_lock(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


LOCK = ".epipole.lock"
_TAKEN = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)


@contextmanager
def alone_in(root: Path) -> Iterator[None]:
    """Make the folder if it is missing, and hold off other runs while the block works in it.

    The system lets go of the lock when the process ends, however it ends. File systems that know no locks get none.

    Raises:
        WorkspaceError: another run works in it, or it cannot be written.
    """
    is_new = not root.exists()
    with reporting(root, "use the output folder"):
        root.mkdir(parents=True, exist_ok=True)
        file = _locked(root)
    try:
        yield
    finally:
        with suppress(OSError):
            if os.name != "nt":  # there an open file cannot be removed
                (root / LOCK).unlink(missing_ok=True)
        os.close(file)
        if is_new:
            with suppress(OSError):  # it holds something
                root.rmdir()


def remove_free_locks(root: Path) -> None:
    """Remove what killed runs have left in folders below this one."""
    for path in root.rglob(LOCK):
        if path.parent != root and path.is_file() and not path.is_symlink():
            with suppress(WorkspaceError, OSError), alone_in(path.parent):
                pass


def _locked(root: Path) -> int:
    """An open lock file that this process alone has."""
    while True:
        file = os.open(root / LOCK, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            _try_lock(file)
        except OSError as error:
            if error.errno in _TAKEN:
                holder = os.read(file, 20).decode("ascii", "replace").strip()
                os.close(file)
                who = f" (process {holder})" if holder.isdigit() else ""
                raise WorkspaceError(
                    f"another run of epipole{who} works in {root}: wait for it, or choose another output folder"
                ) from None
        # The holder before may have removed the file between opening and locking.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file), (root / LOCK).stat()):
                os.truncate(file, 0)
                os.write(file, f"{os.getpid()}\n".encode())
                return file
        os.close(file)
        root.mkdir(parents=True, exist_ok=True)
