"""Executors of units of work: threads, processes, the calling thread, a cluster, or an executor passed by the user."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, Literal

from epipole import _parallel
from epipole.runs.cluster import Cluster, ClusterClient, Connection, connected, joined

ExecutorChoice = Literal["threads", "processes", "inline"] | Executor | Cluster | Connection
"""A name, a cluster, or any `concurrent.futures.Executor`. Its workers must have epipole installed and see the output folder and the
images under the same paths. It is not shut down."""


PassedExecutor = Literal["threads", "processes", "inline"] | Executor | Any
"""What the user passes: a name, an executor, or a `distributed.Client`, whose type is known only where Dask is installed."""


def chosen_executor(
    given: PassedExecutor | None,
    cluster: str | None,
    *,
    has_shared_folder: bool,
    default: ExecutorChoice = "threads",
) -> ExecutorChoice:
    """The executor that is passed, else the cluster of the options, else the default.

    Raises:
        ConfigError: the cluster is no address.
    """
    if isinstance(given, ClusterClient):
        return joined(given, has_shared_folder=has_shared_folder)
    if given is not None:
        chosen: ExecutorChoice = given
        return chosen
    return default if cluster is None else Cluster(cluster, has_shared_folder)


@contextmanager
def started(choice: ExecutorChoice) -> Iterator[ExecutorChoice]:
    """Connect to a cluster for the block; other choices stay as they are.

    Raises:
        MissingDependencyError: `distributed` is not installed.
        WorkspaceError: the cluster cannot be used.
    """
    if isinstance(choice, Cluster):
        with connected(choice) as connection:
            yield connection
    else:
        yield choice


@contextmanager
def opened(choice: ExecutorChoice) -> Iterator[Executor | Connection | None]:
    """What runs the units; None: run them in the calling thread."""
    if isinstance(choice, Executor | Connection):
        yield choice
        return
    if isinstance(choice, Cluster):
        with connected(choice) as connection:
            yield connection
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
