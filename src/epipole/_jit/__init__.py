"""The only Numba configuration of the package.

Kernels are serial and release the GIL; `_parallel` spreads them over threads. They are compiled lazily and cached on disk
(`storage`). The compilation mode is chosen once per process (`mode`).
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

# No nnan or ninf: `fastmath=True` breaks isfinite() and isnan(). No contract or arcp either: they round differently where a
# callee was inlined, so that a cold and a warm cache differed in the last digits; leaving them out has no measurable cost.
SAFE_FASTMATH = {"nsz"}
_COMPILED = "compiled"


def overload_options(
    *, allocates: bool = True, fuse: bool = False, extra_fastmath: frozenset[str] = frozenset()
) -> dict[str, Any]:
    """Options for Numba's `overload`, for functions called only by kernels; see `kernel`."""
    fastmath = SAFE_FASTMATH | extra_fastmath
    if kernel_mode() is KernelMode.LINKED:
        from epipole._jit.linking import linked_overload_options

        return linked_overload_options(fastmath=fastmath, allocates=allocates, fuse=fuse)
    return {"error_model": "numpy", "fastmath": fastmath}


@cache
def cache_folder() -> Path:
    """The cache folder of the kernels that this process compiles."""
    folder = storage.cache_folder(kernel_mode())
    if kernel_mode() is KernelMode.PLAIN:  # linked kernels are checked individually, by digest
        storage.remove_damaged(folder)
    return folder


def is_compiled() -> bool:
    """Whether compiled kernels of this version exist on this machine, or are not needed."""
    return kernel_mode() is KernelMode.PYTHON or storage.read_note(cache_folder(), _COMPILED) is not None


def compiles_on_all_threads() -> bool:
    """Whether several processes may compile at once: only linked kernels are saved under a lock."""
    return kernel_mode() is KernelMode.LINKED


def mark_compiled() -> None:
    """Record that all kernels have been compiled and cached."""
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

    A linked kernel borrows its arrays, without reference counting. Counting is an atomic operation for every array accessed,
    row view or tuple field: it took half the time of bundle adjustment, and more when two threads counted the same arrays.

    Args:
        function: the Python function (annotations are for readers; a type-checking wrapper is removed).
        allocates: whether it creates or returns arrays, which needs reference counting.
        inline: always inline into the calling kernel (for small helpers called per item).
        fuse: the same, but inlined by LLVM: for large helpers called per item with many arrays. Without it every field of every
            array may be passed on the stack at each call.
        extra_fastmath: flags beyond the safe set, for a measured reason (such as `reassoc` for a long dot product).
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
    """Cache kernels declared in this block in the folder."""
    config = cast(Any, numba.config)
    previous = config.CACHE_DIR
    config.CACHE_DIR = str(folder)
    try:
        yield
    finally:
        config.CACHE_DIR = previous


class _CompileClock(numba_event.Listener):
    """Measures the seconds spent compiling; compiling a callee counts as part of its caller.

    Garbage collection is off meanwhile: the compiler keeps most of its objects, and scanning them took a tenth of the time.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self.count = 0
        """Compilations that have ended, callees included."""
        self.current = ""
        """Function that is being compiled, such as `sift.orientations`; empty: none."""
        self._own = threading.local()
        self._collects = False

    def on_start(self, event: Any) -> None:
        """Record the time when the outermost compilation of this thread starts."""
        depth = getattr(self._own, "depth", 0)
        if depth == 0:
            self.current = _name_of(event)
            self._own.start = perf_counter()
            self._collects = gc.isenabled()
            gc.disable()
        self._own.depth = depth + 1

    def on_end(self, event: Any) -> None:  # noqa: ARG002 - the listener's interface
        """Add the elapsed time when it ends."""
        self._own.depth -= 1
        self.count += 1
        if self._own.depth == 0:
            self.current = ""
            self.seconds += perf_counter() - self._own.start
            if self._collects:
                gc.enable()


def _name_of(event: Any) -> str:
    """Module and function that an event is about, such as `sift.orientations`."""
    function = getattr((getattr(event, "data", None) or {}).get("dispatcher"), "py_func", None)
    module = getattr(function, "__module__", "").rpartition(".")[2].strip("_").removesuffix("_kernels")
    return f"{module}.{getattr(function, '__name__', '')}".strip(".")


_clock = _CompileClock()
cast(Any, numba_event).register("numba:compile", _clock)


def compile_seconds() -> float:
    """Seconds this process has spent compiling kernels; zero if all were cached."""
    return _clock.seconds


def compiled_so_far() -> str:
    """What this process has compiled, and is compiling: `12 kernels compiled, now sift.orientations`."""
    now = f", now {_clock.current}" if _clock.current else ""
    return f"{_clock.count} kernel{'' if _clock.count == 1 else 's'} compiled{now}"


def is_compiling() -> bool:
    """Whether this process is compiling a kernel."""
    return bool(_clock.current)
