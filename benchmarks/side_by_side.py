"""Time several programs in turn, each in its own process, after a warm-up.

Short calls are repeated, because the start of threads and new memory take half of a single call of 10 ms.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from multiprocessing import get_context
from typing import Any

from rich.table import Table

ENOUGH_S = 1 / 3
"""Time for which short calls are repeated; the result is the median."""


def _timed(run: Callable[..., Any], data: Any, threads: int, connection: Any) -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        warm_up = data[:8] if isinstance(data, list) else data[:, :100]
        run(warm_up, threads)
        first_start, seconds = time.perf_counter(), []
        while not seconds or time.perf_counter() - first_start < ENOUGH_S:
            start = time.perf_counter()
            out = run(data, threads)
            seconds.append(time.perf_counter() - start)
        connection.send((statistics.median(seconds), out))
    except (ImportError, AttributeError, TypeError) as error:
        connection.send((float("nan"), repr(error)))


def in_own_process(run: Callable[..., Any], data: Any, threads: int) -> tuple[float, Any]:
    """(median seconds, result) after a warm-up; (NaN, error message) if the program is not installed."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_timed, args=(run, data, threads, theirs))
    process.start()
    out = ours.recv()
    process.join()
    return out


def compare(
    programs: dict[str, tuple[Callable[..., Any], int]],
    data: Any,
    rounds: int,
    judge: Callable[[Any], dict[str, float]],
) -> dict[str, Any]:
    """Median seconds of every program (function, number of threads), and `judge` of its last result."""
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    out: dict[str, Any] = {}
    for _ in range(rounds):
        for name, (run, threads) in programs.items():
            one_call, found = in_own_process(run, data, threads)
            seconds[name].append(one_call)
            out[name] = {"error": found} if isinstance(found, str) else judge(found)
    for name, figures in out.items():
        figures["seconds"] = statistics.median(seconds[name])
    return out


def table_of(name: str, rows: dict[str, Any]) -> Table:
    """A table with one row per program."""
    table = Table(title=name)
    columns = list(dict.fromkeys(key for row in rows.values() for key in row))
    for column in ("program", *columns):
        table.add_column(column, justify="right")
    for program, row in rows.items():
        cells = [row.get(c, "") for c in columns]
        table.add_row(program, *(f"{c:.4g}" if isinstance(c, float) else str(c)[:40] for c in cells))
    return table
