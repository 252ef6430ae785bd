"""Numbers of threads of epipole, BLAS and OpenCV, set during a run and restored afterwards."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

from epipole import _parallel

_lock = threading.Lock()
_depth, _before = 0, 0


@contextmanager
def thread_scope(num_threads: int | None = None, *, opencv_alone: bool = False) -> Iterator[None]:
    """Limit BLAS to one thread, on which its results depend, and set the others as requested.

    Args:
        num_threads: threads of epipole's pool; None: unchanged.
        opencv_alone: limit OpenCV to the calling thread, for jobs that process several images at a time.
    """
    before = _parallel.requested_threads()
    if num_threads is not None:
        _parallel.set_num_threads(num_threads)
    try:
        with _parallel.single_threaded_blas():
            if opencv_alone:
                with opencv_in_one_thread():
                    yield
            else:
                yield
    finally:
        if num_threads is not None:
            _parallel.set_num_threads(before)


@contextmanager
def opencv_in_one_thread() -> Iterator[None]:
    """Limit OpenCV to the calling thread.

    The setting is global: the first to enter sets it, the last to leave restores it.
    """
    global _depth, _before  # noqa: PLW0603 - OpenCV's setting is global, too
    with _lock:
        if _depth == 0:
            _before = cv2.getNumThreads()
            cv2.setNumThreads(1)
        _depth += 1
    try:
        yield
    finally:
        with _lock:
            _depth -= 1
            if _depth == 0:
                cv2.setNumThreads(_before)
