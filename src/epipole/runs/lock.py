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
    """Create the folder if it is missing, and lock it against other runs during the block.

    The system releases the lock when the process ends, for any reason. File systems without locks are not locked.

    Raises:
        WorkspaceError: another run uses the folder, or it cannot be written.
    """
    is_new = not root.exists()
    with reporting(root, "use the output folder"):
        root.mkdir(parents=True, exist_ok=True)
        file = _locked(root)
    try:
        yield
    finally:
        with suppress(OSError):
            if os.name != "nt":  # Windows cannot remove an open file
                (root / LOCK).unlink(missing_ok=True)
        os.close(file)
        if is_new:
            with suppress(OSError):  # it is not empty
                root.rmdir()


def remove_free_locks(root: Path) -> None:
    """Remove lock files left by killed runs in folders below this one."""
    for path in root.rglob(LOCK):
        if path.parent != root and path.is_file() and not path.is_symlink():
            with suppress(WorkspaceError, OSError), alone_in(path.parent):
                pass


def _locked(root: Path) -> int:
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
                    f"another run of epipole{who} uses {root}: wait until it ends, or choose another output folder"
                ) from None
        # The previous owner may have removed the file between opening and locking.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file), (root / LOCK).stat()):
                os.truncate(file, 0)
                os.write(file, f"{os.getpid()}\n".encode())
                return file
        os.close(file)
        root.mkdir(parents=True, exist_ok=True)
