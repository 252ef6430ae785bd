"""Run units of work in this thread, in other threads or processes, or on a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, as_completed

from epipole.errors import WorkspaceError
from epipole.runs.cluster import Connection
from epipole.runs.cluster_dispatch import run_on_cluster
from epipole.runs.executors import ExecutorChoice, opened
from epipole.runs.progress import Progress, ProgressCallback, ignore_progress
from epipole.runs.units import Unit, do_unit, do_unit_as_worker, is_done


def run_units(
    units: Sequence[Unit],
    *,
    stage: str,
    executor: ExecutorChoice = "threads",
    progress: ProgressCallback = ignore_progress,
) -> int:
    """Run the units whose files are missing or stale; returns the number of units run.

    After an error or an interrupt, no further unit is started, running ones finish, and the error is raised.

    Raises:
        WorkspaceError: a result cannot be written, or the executor's workers died.
    """
    waiting = [unit for unit in units if not is_done(unit.path, unit.key)]
    total = sum(unit.size for unit in units)
    done = total - sum(unit.size for unit in waiting)
    progress(Progress(stage, done, total))
    with opened(executor if len(waiting) > 1 else "inline") as pool:
        for size in _sizes_done(pool, waiting):
            done += size
            progress(Progress(stage, done, total))
    return len(waiting)


def _sizes_done(pool: Executor | Connection | None, units: Sequence[Unit]) -> Iterator[int]:
    """Run the units; yields the size of each that is done."""
    if pool is None:
        return map(do_unit, units)
    return run_on_cluster(pool, units) if isinstance(pool, Connection) else _shared_out(pool, units)


def _shared_out(pool: Executor, units: Sequence[Unit]) -> Iterator[int]:
    futures = [pool.submit(do_unit_as_worker, unit) for unit in units]
    try:
        for future in as_completed(futures):
            yield future.result()
    except BrokenExecutor as error:
        raise WorkspaceError(
            "the worker processes died: out of memory, or a script that starts them "
            "outside `if __name__ == '__main__':`"
        ) from error
    finally:
        for future in futures:
            future.cancel()
