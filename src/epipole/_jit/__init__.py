"""The only Numba configuration of the package.

Kernels are serial and release the GIL; `_parallel` spreads them over threads. They are compiled lazily and kept on disk
(`storage`). How they are compiled is chosen once in a process (`mode`).
"""

import gc
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from inspect import unwrap
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar, cast

import numba
from numba.core import event as numba_event

from epipole._jit import storage
from epipole._jit.mode import KernelMode, kernel_mode

Function = TypeVar("Function", bound=Callable[..., Any])

# No nnan or ninf: `fastmath=True` makes isfinite() and isnan() lie. No contract or arcp either: they round
# differently where a callee was inlined, so that a cold and a warm cache disagreed in the last digits; leaving
# them out cost no measurable time.
SAFE_FASTMATH = {"nsz"}
_COMPILED = "compiled"


def overload_options(
    *, allocates: bool = True, fuse: bool = False, extra_fastmath: frozenset[str] = frozenset()
) -> dict[str, Any]:
    """Options for Numba's `overload`, whose functions only kernels call; see `kernel`."""
    fastmath = SAFE_FASTMATH | extra_fastmath
    if kernel_mode() is KernelMode.LINKED:
        from epipole._jit.linking import linked_overload_options

        return linked_overload_options(fastmath=fastmath, allocates=allocates, fuse=fuse)
    return {"error_model": "numpy", "fastmath": fastmath}


@cache
def cache_folder() -> Path:
    """The folder of the kernels that this process compiles."""
    folder = storage.cache_folder(kernel_mode())
    if kernel_mode() is KernelMode.PLAIN:  # linked kernels are checked one by one, by digests
        storage.remove_damaged(folder)
    return folder


def is_compiled() -> bool:
    """Whether this machine holds compiled kernels of this version, or needs none."""
    return kernel_mode() is KernelMode.PYTHON or storage.read_note(cache_folder(), _COMPILED) is not None


def compiles_on_all_threads() -> bool:
    """Whether several processes may compile at once: only linked kernels are kept under a lock."""
    return kernel_mode() is KernelMode.LINKED


def mark_compiled() -> None:
    """Note that all kernels have been compiled and kept."""
    storage.write_note(cache_folder(), _COMPILED)


def kernel(
    function: Function | None = None,
    *,
    allocates: bool = False,
    inline: bool = False,
    fuse: bool = False,
    extra_fastmath: frozenset[str] = frozenset(),
) -> Any:
    """Compile a function lazily as a serial, GIL-free, disk-cached kernel.

    A linked kernel borrows its arrays: their references are not counted. Counting is an atomic operation for every
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
    own, fastmath = unwrap(function), SAFE_FASTMATH | extra_fastmath
    if kernel_mode() is KernelMode.PYTHON:
        from epipole._jit.as_python import run_as_python

        return run_as_python(own)
    with _kept_in(cache_folder()):
        if kernel_mode() is KernelMode.PLAIN:
            return numba.njit(nogil=True, cache=True, error_model="numpy", fastmath=fastmath)(own)
        from epipole._jit.linking import linked_kernel

        return linked_kernel(
            own, fastmath=fastmath, allocates=allocates, inline=inline, fuse=fuse, folder=cache_folder()
        )


@contextmanager
def _kept_in(folder: Path) -> Iterator[None]:
    """Kernels declared in this block are cached in the folder."""
    config = cast(Any, numba.config)
    previous = config.CACHE_DIR
    config.CACHE_DIR = str(folder)
    try:
        yield
    finally:
        config.CACHE_DIR = previous


class _CompileClock(numba_event.Listener):
    """Measures the seconds spent compiling; compiling a callee counts as part of its caller.

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
            self._own.start = perf_counter()
            self._collects = gc.isenabled()
            gc.disable()
        self._own.depth = depth + 1

    def on_end(self, event: Any) -> None:  # noqa: ARG002 - the listener's interface
        """Add the time when it ends."""
        self._own.depth -= 1
        if self._own.depth == 0:
            self.seconds += perf_counter() - self._own.start
            if self._collects:
                gc.enable()


_clock = _CompileClock()
cast(Any, numba_event).register("numba:compile", _clock)


def compile_seconds() -> float:
    """Seconds this process has spent compiling kernels; zero when all came from the disk."""
    return _clock.seconds
