"""Console output of all commands: progress with the remaining time, and warnings."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from time import monotonic, perf_counter
from typing import TYPE_CHECKING, Literal

from rich.console import Console, ConsoleOptions, ConsoleRenderable, RenderHook
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.segment import Segment
from rich.text import Text

from epipole._terminal import in_words_of_caller, one_line, terminal_text

if TYPE_CHECKING:
    from epipole.runs import Progress, ProgressCallback

ANSWER_IS_NO = 3
"""Exit code of a check that did not pass; errors have 1, invalid options 2."""
COMPILE_NOTE = (
    "Compiling kernels, once on this machine (one to two minutes on two cores; later runs start immediately)"
)
COMPILING = "compile"
"""The stage that compiles kernels; it has no steps to count."""
CONNECTING = "connect"
"""The stage that connects to a cluster; its total is the number of threads."""
LINE_EVERY_S = 10.0
"""Without a terminal, a stage prints at most one line in this time (seconds) between its start and its end."""
SHORT_S = 1.0
"""Work shorter than this (seconds) is not announced."""
MOST_PRINTED = 10
"""Largest number of warnings or reasons on the screen if a file has all of them."""
Loudness = Literal["quiet", "normal", "verbose"]
_LOUDNESS: ContextVar[Loudness] = ContextVar("loudness", default="normal")


class _Readable:
    """Printed text without terminal control sequences, except Rich's styles and cursor movements."""

    def __init__(self, inner: ConsoleRenderable) -> None:
        self.inner = inner

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Segment]:
        for text, style, control in console.render(self.inner, options):
            yield Segment(text if control else terminal_text(text), style, control)


class _ReadableTexts(RenderHook):
    def process_renderables(self, renderables: list[ConsoleRenderable]) -> list[ConsoleRenderable]:
        return [_Readable(each) for each in renderables]


def open_console(*, stderr: bool = False, quiet: bool = False) -> Console:
    """The console of all commands, in which names are never interpreted as markup or terminal commands."""
    console = Console(stderr=stderr, quiet=quiet, markup=False)
    console.push_render_hook(_ReadableTexts())
    return console


class _Formatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return terminal_text(super().format(record))


@contextmanager
def loudness(requested: Loudness) -> Iterator[None]:
    """Set the amount of output in the block; verbose also shows the package's Python `logging`."""
    token, package = _LOUDNESS.set(requested), logging.getLogger("epipole")
    handler, level = logging.StreamHandler(), package.level
    handler.setFormatter(_Formatter("%(levelname)s %(name)s: %(message)s"))
    if requested == "verbose":
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
    """A progress callback that shows one bar per stage, with the remaining time; without a terminal, it prints lines.

    Args:
        words: labels of stages; others are shown by name.
        compiles_much: announce that kernels compile for half a minute or more.
    """
    from epipole import _jit

    console, start = open_console(stderr=True, quiet=_LOUDNESS.get() == "quiet"), _jit.compile_seconds()
    labels = {CONNECTING: "Threads of the cluster", **(words or {})}
    with _bars(console, labels) if _is_interactive(console) else _lines(console, labels) as show:
        will_compile = compiles_much and not _jit.is_compiled()

        def announce_and_show(report: Progress) -> None:
            nonlocal will_compile
            if will_compile:  # not earlier, so that a wrong path prints only its error
                console.print(COMPILE_NOTE, soft_wrap=True)
                will_compile = False
            show(report)

        yield announce_and_show
    if not compiles_much:
        _say_compiling(console, _jit.compile_seconds() - start)


def _is_interactive(console: Console) -> bool:
    return _LOUDNESS.get() == "normal" and console.is_interactive and sys.stderr.isatty()


@contextmanager
def _bars(console: Console, words: Mapping[str, str]) -> Iterator[ProgressCallback]:
    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(bar_width=32),
        _Count(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Bars(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}
        rounds = _Rounds()

        def show(report: Progress) -> None:
            label = words.get(report.stage, report.stage)
            if report.note:
                console.print(one_line(f"{label}: {report.note}"), markup=False)
            if rounds.starts(report):
                tasks[report.stage] = bars.add_task(label, total=report.total, stage=report.stage)
            bars.update(tasks[report.stage], completed=report.done, total=report.total)

        yield show


class _Count(MofNCompleteColumn):
    """Steps that are done, and of how many; while kernels are compiled, which one."""

    def render(self, task: Task) -> Text:
        if task.fields.get("stage") == COMPILING and not task.finished:
            from epipole import _jit

            return Text(_jit.compiled_so_far(), style="progress.download")
        return super().render(task)


class _Rounds:
    """Detects reports that start a stage, the first time or again."""

    def __init__(self) -> None:
        self._last: dict[str, Progress] = {}
        self._latest_stage = ""

    def starts(self, report: Progress) -> bool:
        """Whether this report, the next one in order, starts its stage, for the first time or again."""
        last, was_other = self._last.get(report.stage), self._latest_stage != report.stage
        self._last[report.stage], self._latest_stage = report, report.stage
        if last is None:
            return True
        if last.done >= last.total:  # finished, unless the total grows, as with frames of a live camera
            return was_other or report.done < min(last.done, report.total)
        return report.done < last.done and (report.done == 0 or report.total != last.total)


@dataclass(slots=True)
class _Stage:
    start_s: float
    printed_s: float
    first_done: int
    """Work that was done earlier."""
    last: Progress
    is_over: bool = False


class _Lines:
    """Output without a terminal: lines for each stage, and one if nothing is reported for long."""

    def __init__(self, console: Console, words: Mapping[str, str]) -> None:
        self._console, self._words = console, words
        self._pause_s = 0.0 if _LOUDNESS.get() == "verbose" else LINE_EVERY_S
        self._stages: dict[str, _Stage] = {}
        self._rounds = _Rounds()
        self._lock = threading.Lock()
        self._latest: _Stage | None = None
        self._start_s = perf_counter()
        self.printed_at = monotonic()
        """Time by `monotonic`."""

    def show(self, report: Progress) -> None:
        """Print a report."""
        with self._lock:
            self._show(report)

    def _show(self, report: Progress) -> None:
        now = perf_counter()
        if self._rounds.starts(report):
            before = self._stages.get(report.stage)
            if before is not None and not before.is_over:
                self._end(before)
            stage = self._stages[report.stage] = _Stage(now, now, report.done, report)
            stage.is_over = report.done >= report.total
            started = (
                f"{report.done} of {report.total} already done"
                if report.done
                else f"started, {report.total} to do"
            )
            if report.stage == COMPILING and not stage.is_over:
                started = "started; this happens once on this machine"
            if report.stage == CONNECTING:
                started = str(report.total)
            self._say(stage, f"{started}; {report.note}" if report.note else started)
        else:
            stage = self._stages[report.stage]
            if report.note:
                self._say(stage, report.note)
        has_grown, is_due = report.done > stage.last.done, now - stage.printed_s >= self._pause_s
        stage.last, self._latest = report, stage
        if report.done >= report.total and not stage.is_over:
            self._end(stage)
        elif is_due and (has_grown or not stage.is_over) and report.done:
            stage.printed_s = now
            self._say(stage, self._how_far(stage, now))

    def _how_far(self, stage: _Stage, now: float) -> str:
        done, total = stage.last.done, stage.last.total
        from epipole import _jit

        if stage.last.stage == COMPILING and done < total:
            return _jit.compiled_so_far()
        if done >= total:
            return f"{done} so far"
        words = f"{done} of {total}, {100 * done // total} %"
        if done <= stage.first_done:
            return f"{words} ({_jit.compiled_so_far()})" if _jit.is_compiling() else words
        left_s = (now - stage.start_s) / (done - stage.first_done) * (total - done)
        return f"{words}, about {left_s:.0f} s left"

    def _end(self, stage: _Stage) -> None:
        stage.is_over, stage.printed_s = True, perf_counter()
        seconds = stage.printed_s - stage.start_s
        if stage.last.stage == COMPILING:
            self._say(stage, f"done after {seconds:.1f} s")
            return
        self._say(stage, f"{stage.last.done} of {stage.last.total} after {seconds:.1f} s")

    def _label(self, stage: _Stage) -> str:
        return self._words.get(stage.last.stage, stage.last.stage)

    def _say(self, stage: _Stage, text: str) -> None:
        self._print(f"{self._label(stage)}: {text}")

    def _print(self, text: str) -> None:
        self.printed_at = monotonic()
        self._console.print(one_line(text), soft_wrap=True, markup=False, highlight=False)

    def beat(self) -> None:
        """Print the progress of the latest stage although it has not reported any."""
        with self._lock:
            stage, now = self._latest, perf_counter()
            if stage is None or stage.is_over:
                after = "" if stage is None else f" (last stage: {self._label(stage)})"
                since_s = now - (self._start_s if stage is None else stage.printed_s)
                self._print(f"Working{after}, {since_s:.0f} s so far")
                return
            stage.printed_s = now
            self._say(stage, f"{self._how_far(stage, now)}, {now - stage.start_s:.0f} s so far")

    def close(self) -> None:
        """Print the last progress of stages that did not finish."""
        with self._lock:
            for stage in self._stages.values():
                if not stage.is_over:
                    self._end(stage)


@contextmanager
def _lines(console: Console, words: Mapping[str, str]) -> Iterator[ProgressCallback]:
    """Print a line when a stage starts and ends, and every ten seconds in between (if verbose, for each report)."""
    lines = _Lines(console, words)
    with _beating(lines.beat, lambda: lines.printed_at):
        try:
            yield lines.show
        finally:
            lines.close()


@contextmanager
def _beating(beat: Callable[[], None], printed_at: Callable[[], float]) -> Iterator[None]:
    """Call `beat` in another thread whenever nothing was printed for `LINE_EVERY_S`, so that long work is never silent."""
    is_over = threading.Event()

    def watch() -> None:
        started_s = monotonic()
        while not is_over.wait(max(0.0, max(started_s, printed_at()) + LINE_EVERY_S - monotonic())):
            if monotonic() - max(started_s, printed_at()) >= LINE_EVERY_S:
                beat()
                started_s = monotonic()

    watcher = threading.Thread(target=watch, name="epipole-heartbeat", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        is_over.set()
        watcher.join()


@contextmanager
def working() -> Iterator[None]:
    """Show a spinner during a short command; mentions that kernels may have to be compiled first."""
    console = open_console(stderr=True, quiet=_LOUDNESS.get() == "quiet")
    from epipole import _jit

    start, since = _jit.compile_seconds(), perf_counter()
    words = "Working (the first run on a machine compiles kernels, for some seconds)"
    if _is_interactive(console):
        with console.status(words):
            yield
    else:
        announcement = threading.Timer(SHORT_S, console.print, (words,), {"soft_wrap": True})

        def beat() -> None:
            console.print(f"Working, {perf_counter() - since:.0f} s so far", soft_wrap=True, highlight=False)

        announcement.start()
        with _beating(beat, lambda: 0.0):
            try:
                yield
            finally:
                announcement.cancel()
                announcement.join()
        if perf_counter() - since > SHORT_S:
            console.print(f"Done after {perf_counter() - since:.1f} s", soft_wrap=True)
    _say_compiling(console, _jit.compile_seconds() - start)


def _say_compiling(console: Console, seconds: float) -> None:
    if seconds > 1.0:
        console.print(
            f"{seconds:.0f} s of this were spent compiling kernels; later runs start immediately",
            soft_wrap=True,
        )


def print_warnings(console: Console, warnings: Iterable[str], word: str = "note", rest_in: str = "") -> None:
    """Print one yellow line per warning.

    Args:
        console: where to print.
        warnings: the warnings.
        word: prefix of each line.
        rest_in: the file that has all warnings, if only the first ten are to be printed and the others counted; empty:
            print all.
    """
    listed = list(warnings)
    shown = listed[:MOST_PRINTED] if rest_in and len(listed) > MOST_PRINTED + 1 else listed
    more = len(listed) - len(shown)
    for warning in [*shown, *([f"{more} more, in {rest_in}"] if more else [])]:
        text = one_line(f"{word}: {in_words_of_caller(warning)}")
        console.print(text, style="yellow", highlight=False, markup=False, soft_wrap=True)


def show_reasons(console: Console, reasons: Mapping[str, str]) -> None:
    """Print why images have no pose, for the first ones."""
    for name, reason in list(reasons.items())[:MOST_PRINTED]:
        console.print(one_line(f"  {name}: {reason}"), highlight=False, markup=False)
    if (more := len(reasons) - MOST_PRINTED) > 0:
        console.print(f"  and {more} more, in the report", highlight=False, markup=False)


def show_location(console: Console, out: Path, files: Mapping[str, Path]) -> None:
    """Print where the results are, and the command that shows them."""
    lines = {**files, "report": out / "report.html", "view": f"epipole view {quote(str(out))}"}
    for name, where in lines.items():
        console.print(f"{name:<7} {where}", highlight=False, markup=False)
