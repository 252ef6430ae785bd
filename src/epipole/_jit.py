"""The only Numba configuration of the package.

Kernels are serial and release the GIL; `_parallel` spreads them over threads. They are compiled lazily and
kept on disk in a folder named by a digest of all kernel sources, because Numba does not notice that a callee
in another file has changed.
"""

import gc
import hashlib
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from inspect import unwrap
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar, cast

import numba
from llvmlite.binding import get_host_cpu_name
from numba.core import config
from numba.core import event as numba_event

from epipole._callees import CalleeCompiler, Kernel

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_numba_config: Any = config
Function = TypeVar("Function", bound=Callable[..., Any])

# No nnan or ninf: `fastmath=True` makes isfinite() and isnan() lie. No contract or arcp either: they round
# differently where a callee was inlined, so that a cold and a warm cache disagreed in the last digits; leaving
# them out cost no measurable time.
SAFE_FASTMATH = {"nsz"}


def overload_options(
    *, allocates: bool = True, fuse: bool = False, extra_fastmath: frozenset[str] = frozenset()
) -> dict[str, Any]:
    """Options for Numba's `overload`, whose functions only kernels call; see `kernel`."""
    return {
        "error_model": "numpy",
        "fastmath": SAFE_FASTMATH | extra_fastmath,
        "forceinline": fuse,
        "_nrt": allocates,
        "no_cpython_wrapper": True,
        "no_cfunc_wrapper": True,
        "pipeline_class": CalleeCompiler,
    }


@cache
def cache_folder() -> Path:
    """The folder of compiled kernels: `$EPIPOLE_CACHE_DIR` or the user's cache, by what they depend on.

    That is the sources, where they stand and since when, Python, Numba and the processor: what Numba itself
    looks at, and the callees in other files that it does not.
    """
    package = Path(__file__).resolve().parent
    digest = hashlib.sha256(
        f"{numba.__version__} {sys.version_info[:2]} {package} {get_host_cpu_name()}".encode()
    )
    for source in sorted([*package.rglob("_*_kernels.py"), package / "_callees.py", Path(__file__)]):
        digest.update(f"{source.stat().st_mtime_ns}".encode())
        digest.update(source.read_bytes())
    name = digest.hexdigest()[:16]
    for base in (_users_cache(), Path(tempfile.gettempdir()) / f"epipole-{_user()}"):
        if base is None:
            continue
        folder = base / "kernels" / name
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            # What stands here is run: nobody else may have put it.
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
    except RuntimeError:  # a user without a home
        return None


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0


@contextmanager
def _alone_in_cache() -> Iterator[None]:
    """Hold off other processes: Numba names a new file after those it has read of, and two could choose one name."""
    with (cache_folder() / "lock").open("w") as stream:
        if fcntl is not None:
            fcntl.flock(stream, fcntl.LOCK_EX)
        yield


def _lock_saving(compiled: Any) -> None:
    file = compiled._cache._cache_file
    save = file.save

    def save_alone(key: Any, data: Any) -> None:
        with _alone_in_cache():
            save(key, data)

    file.save = save_alone


def is_compiled() -> bool:
    """Whether this machine holds compiled kernels of this version."""
    return _marker().is_file()


def mark_compiled() -> None:
    """Note that all kernels have been compiled and kept."""
    with suppress(OSError):
        _marker().touch()


def _marker() -> Path:
    return cache_folder() / "compiled"


def kernel(
    function: Function | None = None,
    *,
    allocates: bool = False,
    inline: bool = False,
    fuse: bool = False,
    extra_fastmath: frozenset[str] = frozenset(),
) -> Any:
    """Compile a function lazily as a serial, GIL-free, disk-cached kernel.

    A kernel borrows its arrays: their references are not counted. Counting is an atomic operation for every
    array that is looked at, row view or tuple field: it took half the time of bundle adjustment, and more where
    two threads counted the same arrays.

    Args:
        function: the Python function (annotations are for readers; a type-checking wrapper is removed).
        allocates: it makes or returns arrays, and has to count.
        inline: always inline into the calling kernel (small helpers that are called per item).
        fuse: the same, but left to LLVM: for large helpers that are called per item with many arrays. Where LLVM does
            not inline by itself, every field of every array goes over the stack at each call.
        extra_fastmath: flags beyond the safe set, for a measured reason (e.g. `reassoc` for a long dot product).
    """
    if function is None:
        return lambda f: kernel(
            f, allocates=allocates, inline=inline, fuse=fuse, extra_fastmath=extra_fastmath
        )
    previous = _numba_config.CACHE_DIR
    _numba_config.CACHE_DIR = str(cache_folder())
    try:
        compiled = Kernel(
            unwrap(function),
            targetoptions={
                "nopython": True,
                "nogil": True,
                "error_model": "numpy",
                "fastmath": SAFE_FASTMATH | set(extra_fastmath),
                "inline": "always" if inline else "never",
                "forceinline": fuse,
                "_nrt": allocates,
                "no_cfunc_wrapper": True,  # for use as a value, which nothing here is; it took 4 % of compiling
            },
        )
        compiled.enable_caching()
        _lock_saving(compiled)
    finally:
        _numba_config.CACHE_DIR = previous
    return cast(Function, compiled)


class _CompileClock(numba_event.Listener):
    """Adds up the seconds spent compiling; compiling a callee counts as part of its caller.

    Garbage is not collected meanwhile: the compiler keeps most of what it makes, and looking through it again and again
    took a tenth of the time.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._own = threading.local()
        self._collects = False

    def on_start(self, event: Any) -> None:  # noqa: ARG002 - the listener's interface
        """Note the time when the outermost compilation of this thread begins."""
        depth = getattr(self._own, "depth", 0)
        if depth == 0:
            self._own.begin = perf_counter()
            self._collects = gc.isenabled()
            gc.disable()
        self._own.depth = depth + 1

    def on_end(self, event: Any) -> None:  # noqa: ARG002 - the listener's interface
        """Add the time when it ends."""
        self._own.depth -= 1
        if self._own.depth == 0:
            self.seconds += perf_counter() - self._own.begin
            if self._collects:
                gc.enable()


_clock = _CompileClock()
cast(Any, numba_event).register("numba:compile", _clock)


def compile_seconds() -> float:
    """Seconds this process has spent compiling kernels; zero when all came from the disk."""
    return _clock.seconds
