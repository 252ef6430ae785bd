"""Executors of units of work: threads, processes, the calling thread, or an executor passed by the user."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Literal

from epipole import _parallel

ExecutorChoice = Literal["threads", "processes", "inline"] | Executor
"""A name, or any `concurrent.futures.Executor`, such as Dask's `Client.get_executor()`. Its workers must have epipole
installed and see the output folder and the images under the same paths. It is not shut down."""


@contextmanager
def opened(choice: ExecutorChoice) -> Iterator[Executor | None]:
    """The executor that runs the units; None: run them in the calling thread."""
    if isinstance(choice, Executor):
        yield choice
        return
    count = _parallel.num_threads()
    if choice == "inline" or count == 1:
        yield None
        return
    pool: Executor
    if choice == "processes":
        pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"))
    else:
        pool = ThreadPoolExecutor(count, thread_name_prefix="epipole-unit")
    with pool:
        yield pool
