"""Where compiled kernels are kept.

The folder is named by a digest of all kernel sources, because Numba does not notice that a callee in another file has
changed.
"""

import hashlib
import os
import sys
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

import numba
from llvmlite.binding import get_host_cpu_name

_PACKAGE = Path(__file__).resolve().parents[1]


@cache
def cache_folder(mode: str) -> Path:
    """The folder of kernels compiled in this mode: in `$EPIPOLE_CACHE_DIR` or the user's cache.

    Its name is a digest of all they depend on: the sources with their paths and times, Python, Numba and the
    processor; also of callees in other files, which Numba's own cache ignores.
    """
    digest = hashlib.sha256(
        f"{mode} {numba.__version__} {sys.version_info[:2]} {_PACKAGE} {get_host_cpu_name()}".encode()
    )
    for source in sorted([*_PACKAGE.rglob("_*_kernels.py"), *Path(__file__).parent.glob("*.py")]):
        digest.update(f"{source.stat().st_mtime_ns}".encode())
        digest.update(source.read_bytes())
    name = digest.hexdigest()[:16]
    for base in (_users_cache(), Path(tempfile.gettempdir()) / f"epipole-{_user()}"):
        if base is None:
            continue
        folder = base / "kernels" / name
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            # Cached code is executed: the folder must belong to this user.
            is_ours = not hasattr(os, "getuid") or folder.stat().st_uid == os.getuid()
        except OSError:
            continue
        if is_ours and os.access(folder, os.W_OK):
            return folder
    return Path(tempfile.mkdtemp(prefix="epipole-kernels-"))


def _users_cache() -> Path | None:
    if asked := os.environ.get("EPIPOLE_CACHE_DIR"):
        return Path(asked)
    if asked := os.environ.get("XDG_CACHE_HOME"):
        return Path(asked) / "epipole"
    try:
        return Path.home() / ".cache" / "epipole"
    except RuntimeError:  # a user without a home folder
        return None


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0


def read_note(folder: Path, name: str) -> str | None:
    """A note left by an earlier process in a folder of kernels; None: there is none."""
    try:
        return (folder / name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None


def write_note(folder: Path, name: str, text: str = "") -> None:
    """Leave a note for later processes; one that cannot be written is computed again."""
    with suppress(OSError):
        (folder / name).write_text(text, encoding="utf-8")
