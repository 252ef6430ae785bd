"""Storage of compiled kernels.

The folder name is a digest of all kernel sources, because Numba does not detect changes of callees in other files.
"""

import atexit
import hashlib
import io
import os
import pickletools
import shutil
import stat
import sys
import tempfile
import warnings
from contextlib import suppress
from functools import cache
from pathlib import Path

import numba
from llvmlite.binding import get_host_cpu_name

_PACKAGE = Path(__file__).resolve().parents[1]


@cache
def cache_folder(mode: str) -> Path:
    """The folder of kernels compiled in this mode: in `$EPIPOLE_CACHE_DIR` or the user's cache.

    Its name is a digest of everything they depend on: sources with their paths and times (including callees in other files, which
    Numba's own cache ignores), Python, Numba and the processor.
    """
    digest = hashlib.sha256(
        f"{mode} {numba.__version__} {sys.version_info[:2]} {_PACKAGE} {get_host_cpu_name()}".encode()
    )
    for source in sorted([*_PACKAGE.rglob("_*_kernels.py"), *Path(__file__).parent.glob("*.py")]):
        digest.update(f"{source.stat().st_mtime_ns}".encode())
        digest.update(source.read_bytes())
    name = digest.hexdigest()[:16]
    refused = ""
    for base in (_users_cache(), Path(tempfile.gettempdir()) / f"epipole-{_user()}"):
        if base is None:
            continue
        folder = base / "kernels" / name
        try:
            _make_private(folder)
            if why := why_not_trusted(folder):
                refused = refused or why
            elif os.access(folder, os.W_OK):
                if refused and "EPIPOLE_CACHE_DIR" in os.environ:
                    _warn(f"compiled kernels are saved in {folder}, because {refused}")
                return folder
        except OSError as error:
            refused = refused or f"{folder}: {error.strerror}"
    _warn(
        f"compiled kernels cannot be saved, because {refused}: every run compiles them again. "
        "Set $EPIPOLE_CACHE_DIR to another folder"
    )
    private = tempfile.mkdtemp(prefix="epipole-kernels-")
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    return Path(private)


def _warn(text: str) -> None:
    warnings.warn(f"epipole: {text}", RuntimeWarning, stacklevel=3)


def why_not_trusted(folder: Path) -> str:
    """Why compiled code in a folder cannot be trusted: who else may write to it or to a parent; empty if nobody can.

    Anyone who can rename a parent folder can replace this one. Only in a folder with the sticky bit, such as `/tmp`, are files of
    other users protected.
    """
    if not hasattr(os, "getuid"):
        return ""
    for part in (given := folder.resolve(), *given.parents):
        state = part.stat()
        if state.st_uid not in (os.getuid(), 0):
            return f"{part} belongs to another user"
        is_sticky = state.st_mode & stat.S_ISVTX and part != given
        if state.st_mode & stat.S_IWOTH and not is_sticky:
            return f"anyone may write to {part}"
        if state.st_mode & stat.S_IWGRP and not is_sticky and not _is_own_group(state.st_gid):
            return f"a group may write to {part}"
    return ""


def _is_own_group(group: int) -> bool:
    """Whether a group contains only this user, as on many systems."""
    import grp
    import pwd

    try:
        found, user = grp.getgrgid(group), pwd.getpwuid(os.getuid())
    except KeyError:
        return False
    return found.gr_name == user.pw_name and set(found.gr_mem) <= {user.pw_name}


def _make_private(folder: Path) -> None:
    """Create the folder and its parents, accessible to this user only."""
    for part in reversed([folder, *folder.parents]):
        with suppress(FileExistsError):
            part.mkdir(mode=0o700)
    if not folder.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        with suppress(PermissionError):  # belongs to another user, and will be rejected
            folder.chmod(0o700)  # files in it may then have any mode


def _users_cache() -> Path | None:
    if requested := os.environ.get("EPIPOLE_CACHE_DIR"):
        return Path(requested)
    if requested := os.environ.get("XDG_CACHE_HOME"):
        return Path(requested) / "epipole"
    try:
        return Path.home() / ".cache" / "epipole"
    except RuntimeError:  # no home folder
        return None


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0


def remove_damaged(folder: Path) -> None:
    """Remove truncated kernel files: Numba would fail on them in every run."""
    for path in folder.rglob("*.nb[ic]"):
        with suppress(OSError):
            if not _is_pickled(path.read_bytes()):
                path.unlink()


def _is_pickled(content: bytes) -> bool:
    """Whether the content is a sequence of complete pickles; nothing is unpickled."""
    stream = io.BytesIO(content)
    try:
        while stream.tell() < len(content):
            for _ in pickletools.genops(stream):
                pass
    except (ValueError, UnicodeDecodeError):
        return False
    return bool(content)


def read_note(folder: Path, name: str) -> str | None:
    """A note left by an earlier process in a cache folder; None if there is none."""
    try:
        return (folder / name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None


def write_note(folder: Path, name: str, text: str = "") -> None:
    """Leave a note for later processes; if it cannot be written, it is computed again."""
    with suppress(OSError):
        (folder / name).write_text(text, encoding="utf-8")
