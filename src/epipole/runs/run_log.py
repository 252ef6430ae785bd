"""Log file of a run: progress, rates, memory and the time of each stage, for long runs that nobody watches."""

from __future__ import annotations

import threading
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from time import perf_counter

from epipole.runs.memory import memory_mb
from epipole.runs.progress import Progress

NAME = "log.txt"
EVERY_S = 10.0
"""A stage writes at most one line in this time (seconds) between its start and its end."""


class RunLog:
    """Appends lines to a file; if that is impossible, the run goes on without them."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, threading.Lock()
        self._stage, self._done = "", 0
        self._start = (0, 0.0)
        """Steps that were done when the stage was first reported, and when that was."""
        self._written_s = 0.0

    def write(self, stage: str, words: str) -> None:
        """Append a line with the time and the present memory."""
        memory = memory_mb()
        used = "" if memory is None else f"{memory:,.0f} MB"
        now = f"{datetime.now().astimezone():%Y-%m-%d %H:%M:%S}"
        with suppress(OSError), self._path.open("a", encoding="utf-8") as stream:
            stream.write(f"{now}  {stage:<12} {words:<52} {used}".rstrip() + "\n")

    def add(self, report: Progress) -> None:
        """Append the progress of a stage, if it is its first or last report or none was written for a while."""
        with self._lock:
            now = perf_counter()
            is_first = report.stage != self._stage or report.done < self._done
            if is_first:
                self._stage, self._start = report.stage, (report.done, now)
            self._done = report.done
            is_last = report.done >= report.total
            if not (is_first or is_last or report.note or now - self._written_s >= EVERY_S):
                return
            self._written_s = now
            self.write(report.stage, self._in_words(report, now))

    def _in_words(self, report: Progress, now: float) -> str:
        done, seconds = report.done - self._start[0], now - self._start[1]
        parts = [f"{report.done:,} of {report.total:,}"]
        if done > 0 and seconds > 0:
            rate = done / seconds
            parts.append(f"{rate:.3g}/s")
            if report.done < report.total:
                parts.append(f"{(report.total - report.done) / rate:,.0f} s left")
        return ", ".join(parts) + (f"; {report.note}" if report.note else "")
