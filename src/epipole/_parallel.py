"""The shared thread pool, and fixed chunks that make results independent of the number of threads."""

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from itertools import pairwise
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

Result = TypeVar("Result")

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_num_threads: int | None = None
_inside = threading.local()
_blas_lock = threading.Lock()
_blas_depth = 0
_blas_limit: Any = None


def available_cpus() -> int:
    """Number of processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return max(1, os.cpu_count() or 1)


def num_threads() -> int:
    """Threads used for parallel work: `set_num_threads`, else `$EPIPOLE_NUM_THREADS`, else one per processor."""
    if _num_threads is not None:
        return _num_threads
    requested = os.environ.get("EPIPOLE_NUM_THREADS", "")
    return max(1, int(requested)) if requested.isdecimal() else available_cpus()


def set_num_threads(count: int | None) -> None:
    """Set the number of threads (None: back to the default). Results do not depend on it."""
    global _num_threads, _pool  # noqa: PLW0603 - the one pool of the process
    with _lock:
        _num_threads = None if count is None else max(1, int(count))
        if _pool is not None:
            _pool.shutdown(wait=True)
            _pool = None


def requested_threads() -> int | None:
    """The last argument of `set_num_threads`."""
    return _num_threads


def _shared_pool() -> ThreadPoolExecutor:
    global _pool  # noqa: PLW0603 - the one pool of the process
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max(1, num_threads() - 1), thread_name_prefix="epipole")
        return _pool


def _drop_pool_after_fork() -> None:
    global _pool, _lock
    _pool, _lock = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_drop_pool_after_fork)


def lower_priority_here(by: int) -> None:
    """Let the scheduler prefer other threads to the present one; does nothing where only processes have priorities.

    Args:
        by: increase of the niceness, whose largest value is 19. A thread gets a tenth of the time of one with a niceness lower by 10.
    """
    if sys.platform == "linux":  # elsewhere, the call concerns the whole process
        thread = threading.get_native_id()
        with suppress(OSError):  # a sandbox may refuse it
            os.setpriority(os.PRIO_PROCESS, thread, min(19, os.getpriority(os.PRIO_PROCESS, thread) + by))


def chunk_bounds(num_items: int, num_chunks: int) -> list[tuple[int, int]]:
    """Split range(num_items) into at most num_chunks (start, stop) intervals of nearly equal length."""
    num_chunks = max(1, min(num_chunks, num_items))
    edges = [num_items * c // num_chunks for c in range(num_chunks + 1)]
    return [(a, b) for a, b in pairwise(edges) if b > a]


def map_chunks(work: Callable[[int, int, int], Result], num_items: int, num_chunks: int = 16) -> list[Result]:
    """Call work(start, stop, chunk) for fixed chunks of range(num_items); results are in chunk order.

    The chunks depend only on num_items and num_chunks, so sums reduced in this order do not depend on the number of threads. The
    calling thread takes part, as handing every chunk to another thread took longer than many of the chunks. Inside a worker, work
    runs inline. After an error, chunks that have not started are skipped.
    """
    bounds = chunk_bounds(num_items, num_chunks)
    if len(bounds) <= 1 or num_threads() == 1 or getattr(_inside, "worker", False):
        return [work(start, stop, c) for c, (start, stop) in enumerate(bounds)]
    results: dict[int, Result] = {}
    waiting = deque(range(len(bounds)))  # popleft is thread-safe

    def take_part() -> None:
        _inside.worker = True
        try:
            while True:
                try:
                    c = waiting.popleft()
                except IndexError:
                    return
                results[c] = work(*bounds[c], c)
        except BaseException:
            waiting.clear()
            raise
        finally:
            _inside.worker = False

    pool = _shared_pool()
    helpers = [pool.submit(take_part) for _ in range(min(num_threads(), len(bounds)) - 1)]
    try:
        take_part()
    finally:
        started = [helper for helper in helpers if not helper.cancel()]
        wait(started)
    for helper in started:
        helper.result()
    return [results[c] for c in range(len(bounds))]


def map_items(work: Callable[[int], Result], num_items: int) -> list[Result]:
    """Call work(i) for each i of range(num_items) on the shared pool; results are in order."""
    return map_chunks(lambda start, _stop, _chunk: work(start), num_items, num_items)


@contextmanager
def inline_here() -> Iterator[None]:
    """Run parallel work of this thread inline inside the block, as in a worker."""
    before = getattr(_inside, "worker", False)
    _inside.worker = True
    try:
        yield
    finally:
        _inside.worker = before


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Limit BLAS to one thread: its results depend on the thread count, and our own threads are faster.

    The setting is global: with overlapping threads, the first to enter sets it, and the last to leave restores it.
    """
    global _blas_depth, _blas_limit  # noqa: PLW0603 - the BLAS setting is global, too
    with _blas_lock:
        if _blas_depth == 0:
            _blas_limit = _blas_libraries().limit(limits=1, user_api="blas")
        _blas_depth += 1
    try:
        yield
    finally:
        with _blas_lock:
            _blas_depth -= 1
            if _blas_depth == 0:
                _blas_limit.restore_original_limits()


@cache
def _blas_libraries() -> ThreadpoolController:
    """The BLAS libraries of NumPy and SciPy, searched only once, as that takes two milliseconds."""
    import_module("scipy.linalg")
    return ThreadpoolController()
