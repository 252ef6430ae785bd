"""What all commands print: progress with the time left, and warnings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars

if TYPE_CHECKING:
    from epipole.runs import Progress, ProgressCallback

ANSWER_IS_NO = 3
"""Exit code of a check that ran and did not pass; errors have 1, wrong usage 2."""
COMPILE_NOTE = "Compiling kernels, once on this machine (about a minute; later runs start at once)"


@contextmanager
def progress_on_screen(
    words: Mapping[str, str] | None = None, *, compiles_much: bool = False
) -> Iterator[ProgressCallback]:
    """A progress callback that draws one bar per stage, with the time left.

    Args:
        words: labels of the stages; others are shown by their names.
        compiles_much: announce that kernels compile for about a minute.
    """
    words = words or {}
    columns = (
        *(TextColumn("{task.description:<22}"), BarColumn(bar_width=32), MofNCompleteColumn()),
        *(TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()),
    )
    from epipole import _jit

    console, begin = Console(stderr=True), _jit.compile_seconds()
    with Bars(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        if compiles_much and not _jit.is_compiled():
            bars.console.print(COMPILE_NOTE)

        def show(report: Progress) -> None:
            if report.stage not in tasks:
                tasks[report.stage] = bars.add_task(words.get(report.stage, report.stage), total=report.total)
            bars.update(tasks[report.stage], completed=report.done, total=report.total)

        yield show
    if not compiles_much:
        _say_compiling(console, _jit.compile_seconds() - begin)


@contextmanager
def waiting_for_kernels() -> Iterator[None]:
    """A spinner while a short command works, which says so if kernels have to be compiled first."""
    console = Console(stderr=True)
    from epipole import _jit

    begin = _jit.compile_seconds()
    with console.status("Working (the first run on a machine compiles kernels, for some seconds)"):
        yield
    _say_compiling(console, _jit.compile_seconds() - begin)


def _say_compiling(console: Console, seconds: float) -> None:
    if seconds > 1.0:
        console.print(f"{seconds:.0f} s of this went into compiling kernels; later runs start at once")


def print_warnings(console: Console, warnings: Iterable[str], word: str = "note") -> None:
    """Print one yellow line per warning."""
    for warning in warnings:
        console.print(f"{word}: {warning}", style="yellow", highlight=False, markup=False)
