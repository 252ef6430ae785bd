"""Log file of a run: progress, rates, memory and the time of each stage, for long runs that nobody watches."""

from __future__ import annotations

import math
import threading
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from time import perf_counter

from epipole.runs.memory import memory_mb
from epipole.runs.progress import Progress

NAME = "log.txt"
EVERY_S = 10.0
"""A stage writes at most one line in this time (seconds) between its start and its end."""


@dataclass(slots=True)
class _Stage:
    """The reports of a stage since it started, or started again."""

    first: int
    """Steps that were done at its first report."""
    start_s: float
    done: int
    total: int
    written_s: float
    """Time of its last line."""


class RunLog:
    """Appends lines to a file; if that is impossible, the run goes on without them."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, threading.Lock()
        self._stages: dict[str, _Stage] = {}

    def write(self, stage: str, words: str) -> None:
        """Append a line with the time and the present memory."""
        memory = memory_mb()
        used = "" if memory is None else f"{memory:,.0f} MB"
        now = f"{datetime.now().astimezone():%Y-%m-%d %H:%M:%S}"
        # File names that are no text are escaped.
        with suppress(OSError), self._path.open("a", encoding="utf-8", errors="backslashreplace") as stream:
            stream.write(f"{now}  {stage:<12} {words:<52} {used}".rstrip() + "\n")

    def add(self, report: Progress) -> None:
        """Append the progress of a stage, if it is its first or last report or none was written for a while."""
        with self._lock:
            now = perf_counter()
            stage = self._stages.get(report.stage)
            is_first = stage is None or report.done < stage.done
            if stage is None or is_first:
                written_s = -math.inf if stage is None else stage.written_s
                stage = _Stage(report.done, now, report.done, report.total, written_s)
                self._stages[report.stage] = stage
            # The total of a stream whose length is unknown grows with it.
            is_last = report.done >= report.total == stage.total
            stage.done, stage.total = report.done, report.total
            if report.note or is_last or now - stage.written_s >= EVERY_S:
                stage.written_s = now
                self.write(report.stage, _in_words(report, report.done - stage.first, now - stage.start_s))


def _in_words(report: Progress, done: int, seconds: float) -> str:
    parts = [f"{report.done:,} of {report.total:,}"]
    if done > 0 and seconds > 0:
        rate = done / seconds
        parts.append(f"{rate:.3g}/s")
        if report.done < report.total:
            parts.append(f"{(report.total - report.done) / rate:,.0f} s left")
    return ", ".join(parts) + (f"; {report.note}" if report.note else "")
