"""Whole calls of several programs in turn, each in a process of its own, after a warm-up.

Short calls are made again until a third of a second is over, and their median counts: of single ones of 10 ms the threads' start and fresh memory are half.
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


def _timed(run: Callable[..., Any], data: Any, threads: int, connection: Any) -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        warm = data[:8] if isinstance(data, list) else data[:, :100]
        run(warm, threads)
        begin, took = time.perf_counter(), []
        while not took or time.perf_counter() - begin < ENOUGH_S:
            start = time.perf_counter()
            out = run(data, threads)
            took.append(time.perf_counter() - start)
        connection.send((statistics.median(took), out))
    except (ImportError, AttributeError, TypeError) as error:
        connection.send((float("nan"), repr(error)))


def in_own_process(run: Callable[..., Any], data: Any, threads: int) -> tuple[float, Any]:
    """(median seconds, result) after a warm-up; NaN and the words of the error if the program is not there."""
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
    """Median seconds of every program (function and number of threads) and what `judge` says of its last answer."""
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    out: dict[str, Any] = {}
    for _ in range(rounds):
        for name, (run, threads) in programs.items():
            took, found = in_own_process(run, data, threads)
            seconds[name].append(took)
            out[name] = {"error": found} if isinstance(found, str) else judge(found)
    for name, figures in out.items():
        figures["seconds"] = statistics.median(seconds[name])
    return out


def table_of(name: str, rows: dict[str, Any]) -> Table:
    """A row for each program."""
    table = Table(title=name)
    columns = list(dict.fromkeys(key for row in rows.values() for key in row))
    for column in ("program", *columns):
        table.add_column(column, justify="right")
    for program, row in rows.items():
        cells = [row.get(c, "") for c in columns]
        table.add_row(program, *(f"{c:.4g}" if isinstance(c, float) else str(c)[:40] for c in cells))
    return table
