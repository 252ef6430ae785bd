"""What all commands print: progress with the time left, and warnings; on a terminal, in a log file, or not at all."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Literal

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
"""Exit code of a check that ran and did not pass; errors have 1, options that cannot be used 2."""
COMPILE_NOTE = "Compiling kernels, once on this machine (half a minute to a minute; later runs start at once)"
LINE_EVERY_S = 10.0
"""Where there is no terminal to draw bars on, a stage prints a line at most this often between begin and end."""
SHORT_S = 1.0
"""Work that is over sooner needs no announcement."""
MOST_PRINTED = 10
"""Warnings on the screen, where a file holds them all."""
Loudness = Literal["quiet", "normal", "verbose"]
_LOUDNESS: ContextVar[Loudness] = ContextVar("loudness", default="normal")


@contextmanager
def loudness(asked: Loudness) -> Iterator[None]:
    """How much is printed in the block; verbose also shows what the package writes to Python's `logging`."""
    token, package = _LOUDNESS.set(asked), logging.getLogger("epipole")
    handler, level = logging.StreamHandler(), package.level
    handler.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
    if asked == "verbose":
        package.addHandler(handler)
        package.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        _LOUDNESS.reset(token)
        package.removeHandler(handler)
        package.setLevel(level)


@contextmanager
def progress_on_screen(
    words: Mapping[str, str] | None = None, *, compiles_much: bool = False
) -> Iterator[ProgressCallback]:
    """A progress callback that draws one bar per stage, with the time left; without a terminal, it prints lines.

    Args:
        words: labels of the stages; others are shown by their names.
        compiles_much: announce that kernels compile for half a minute or more.
    """
    from epipole import _jit

    console, begin = Console(stderr=True, quiet=_LOUDNESS.get() == "quiet"), _jit.compile_seconds()
    with _bars(console, words or {}) if _draws_on(console) else _lines(console, words or {}) as show:
        will_compile = compiles_much and not _jit.is_compiled()

        def announce_and_show(report: Progress) -> None:
            nonlocal will_compile
            if will_compile:  # not before anything works: a wrong path should be all that is said
                console.print(COMPILE_NOTE, soft_wrap=True)
                will_compile = False
            show(report)

        yield announce_and_show
    if not compiles_much:
        _say_compiling(console, _jit.compile_seconds() - begin)


def _draws_on(console: Console) -> bool:
    return _LOUDNESS.get() == "normal" and console.is_interactive and sys.stderr.isatty()


@contextmanager
def _bars(console: Console, words: Mapping[str, str]) -> Iterator[ProgressCallback]:
    columns = (
        *(TextColumn("{task.description:<22}"), BarColumn(bar_width=32), MofNCompleteColumn()),
        *(TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()),
    )
    with Bars(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def show(report: Progress) -> None:
            if report.note:
                console.print(f"{words.get(report.stage, report.stage)}: {report.note}", markup=False)
            if report.stage not in tasks:
                tasks[report.stage] = bars.add_task(words.get(report.stage, report.stage), total=report.total)
            bars.update(tasks[report.stage], completed=report.done, total=report.total)

        yield show


@dataclass(slots=True)
class _Stage:
    begin_s: float
    printed_s: float
    last: Progress
    is_over: bool = False


@contextmanager
def _lines(console: Console, words: Mapping[str, str]) -> Iterator[ProgressCallback]:
    """One line where a stage begins, one where it ends, and one every ten seconds, or, if verbose, for each report."""
    stages: dict[str, _Stage] = {}
    pause_s = 0.0 if _LOUDNESS.get() == "verbose" else LINE_EVERY_S

    def say(stage: _Stage, text: str) -> None:
        console.print(
            f"{words.get(stage.last.stage, stage.last.stage)}: {text}",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )

    def end(stage: _Stage) -> None:
        stage.is_over = True
        seconds = perf_counter() - stage.begin_s
        say(stage, f"{stage.last.done} of {stage.last.total} after {seconds:.1f} s")

    def show(report: Progress) -> None:
        now = perf_counter()
        stage = stages.get(report.stage)
        if stage is None:
            stage = stages[report.stage] = _Stage(now, now, report)
            stage.is_over = report.done >= report.total
            done = (
                f"{report.done} of {report.total} are done"
                if report.done
                else f"begins, {report.total} to do"
            )
            say(stage, f"{done}; {report.note}" if report.note else done)
        stage.last = report
        if stage.is_over:
            return
        if report.done >= report.total:
            end(stage)
        elif report.done and now - stage.printed_s >= pause_s:
            stage.printed_s = now
            left_s = (now - stage.begin_s) / report.done * (report.total - report.done)
            share = 100 * report.done // report.total
            say(stage, f"{report.done} of {report.total}, {share} %, about {left_s:.0f} s left")

    try:
        yield show
    finally:
        for stage in stages.values():
            if not stage.is_over:
                end(stage)


@contextmanager
def waiting_for_kernels() -> Iterator[None]:
    """A spinner while a short command works, which says so if kernels have to be compiled first."""
    console = Console(stderr=True, quiet=_LOUDNESS.get() == "quiet")
    from epipole import _jit

    begin, since = _jit.compile_seconds(), perf_counter()
    words = "Working (the first run on a machine compiles kernels, for some seconds)"
    if _draws_on(console):
        with console.status(words):
            yield
    else:
        announcement = threading.Timer(SHORT_S, console.print, (words,), {"soft_wrap": True})
        announcement.start()
        try:
            yield
        finally:
            announcement.cancel()
            announcement.join()
        if perf_counter() - since > SHORT_S:
            console.print(f"Done after {perf_counter() - since:.1f} s", soft_wrap=True)
    _say_compiling(console, _jit.compile_seconds() - begin)


def _say_compiling(console: Console, seconds: float) -> None:
    if seconds > 1.0:
        console.print(
            f"{seconds:.0f} s of this went into compiling kernels; later runs start at once", soft_wrap=True
        )


def print_warnings(console: Console, warnings: Iterable[str], word: str = "note", rest_in: str = "") -> None:
    """Print one yellow line per warning.

    Args:
        console: where to.
        warnings: the warnings.
        word: before each.
        rest_in: the file that holds all of them, where only the first ten are printed and the others counted; empty: all
            are printed.
    """
    listed = list(warnings)
    shown = listed[:MOST_PRINTED] if rest_in and len(listed) > MOST_PRINTED + 1 else listed
    more = len(listed) - len(shown)
    for warning in [*shown, *([f"{more} more, in {rest_in}"] if more else [])]:
        console.print(f"{word}: {warning}", style="yellow", highlight=False, markup=False, soft_wrap=True)
