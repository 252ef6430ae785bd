"""One run of a job: its folder, threads, units of work, timings and warnings."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from epipole._checks import check_fields, checked
from epipole._version import __version__
from epipole.errors import WorkspaceError
from epipole.runs.cluster import Connection
from epipole.runs.dispatch import run_units
from epipole.runs.executors import ExecutorChoice, started
from epipole.runs.folder import MARK, OutputFolder, check_output_path, claim, read_mark
from epipole.runs.lock import alone_in
from epipole.runs.memory import peak_memory_mb
from epipole.runs.progress import Progress, ProgressCallback, ignore_progress
from epipole.runs.run_log import NAME as LOG
from epipole.runs.run_log import RunLog
from epipole.runs.threads import thread_scope
from epipole.runs.units import Unit, digest, remove_other_results


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Job:
    """The command to run, with its inputs and settings."""

    kind: str
    """The command's name."""
    inputs: tuple[Path, ...]
    """Files and folders that are read; they identify the source of the results."""
    settings: Mapping[str, Any]
    """Everything that the results depend on; written to `config.json` with the version."""
    threads: int | None = None
    executor: ExecutorChoice = "threads"
    progress: ProgressCallback = ignore_progress
    opencv_alone: bool = False
    """See `thread_scope`."""
    has_log: bool = False
    """Whether the run writes `log.txt`, with the progress of all stages."""

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ConfigError: a field has the wrong type.
        """
        check_fields(self)


class Run:
    """A run in progress. Created by `open_run`."""

    def __init__(self, job: Job, folder: OutputFolder) -> None:
        self._log = None if not job.has_log else _open_log(folder)
        self.job, self.folder = replace(job, progress=self._report), folder
        self._show = job.progress
        self.warnings: list[str] = []
        self.peak_memory_mb: dict[str, float | None] = {}
        """Largest memory of this process up to the end of each stage."""
        self._start = perf_counter()
        # Timings of a stopped run are added; those of a finished run only if its units are reused.
        self._earlier_s = {} if folder.finished else folder.timings_s
        self._finished_s = folder.timings_s if folder.finished else {}
        folder.finished, folder.has_failed, folder.timings_s = "", False, {}
        folder.save()

    @property
    def root(self) -> Path:
        """The output folder."""
        return self.folder.root

    @property
    def timings_s(self) -> dict[str, float]:
        """Seconds of each stage, including those of stopped runs that this one continues."""
        return self.folder.timings_s

    @property
    def seconds(self) -> float:
        """Seconds since this run started."""
        return perf_counter() - self._start

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent in the block to a stage."""
        start = perf_counter()
        try:
            yield
        finally:
            seconds = perf_counter() - start
            self.timings_s[name] = self.timings_s.get(name, self._earlier_s.pop(name, 0.0)) + seconds
            self.peak_memory_mb[name] = peak_memory_mb()
            if self._log is not None:
                self._log.write(name, f"ended after {seconds:,.1f} s")

    def _report(self, report: Progress) -> None:
        if self._log is not None:
            self._log.add(report)
        self._show(report)

    def report(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Report the progress of a stage, with an optional note."""
        self.job.progress(Progress(stage, done, total, note))

    def do(self, units: Sequence[Unit], stage: str) -> None:
        """Run the units whose results are missing or stale, and remove other results from their folders."""
        done = run_units(units, stage=stage, executor=self.job.executor, progress=self.job.progress)
        for folder in {unit.path.parent: None for unit in units}:
            remove_other_results(folder, units)
        if done < len(units) and stage in self._finished_s:
            self._earlier_s[stage] = self._finished_s.pop(stage)

    def note_end(self, error: BaseException) -> None:
        """Write to the log why the run ends."""
        if self._log is not None:
            self._log.write("stopped", f"{type(error).__name__}: {error}".splitlines()[0])

    def close(self) -> None:
        """Save the timings for a run that continues this one."""
        if (self.root / MARK).is_file():
            self.folder.timings_s = {**self._earlier_s, **self.timings_s}
            self.folder.save()

    def finish(self, summary: Mapping[str, Any] | None = None) -> None:
        """Write `config.json` and `summary.json`, and mark the results as complete."""
        self.folder.write_json("config.json", {"version": __version__, **self.job.settings})
        if summary is not None:
            self.folder.write_json("summary.json", {"version": __version__, **summary})
        if self._log is not None:
            peak = max((mb for mb in self.peak_memory_mb.values() if mb is not None), default=None)
            self._log.write(
                "finished",
                f"after {self.seconds:,.1f} s" + ("" if peak is None else f", at most {peak:,.0f} MB"),
            )
        self.folder.finished = digest(__version__, self.job.settings)
        self.folder.save()


def _open_log(folder: OutputFolder) -> RunLog | None:
    """The log of all runs in this folder; None if it has another file of that name."""
    path = folder.root / LOG
    is_own = LOG in folder.files.get("log", ())
    if os.path.lexists(path) and not is_own:
        return None
    folder.files["log"] = [LOG]
    log = RunLog(path)
    log.write("started", f"epipole {__version__} {folder.kind}")
    return log


@checked
@contextmanager
def open_run(job: Job, out: Path) -> Iterator[Run]:
    """Claim the output folder and set the number of threads; finished results stay if the block raises.

    Raises:
        WorkspaceError: the folder belongs to another job, is used by another run, or cannot be written.
    """
    check_output_path(out, job.kind, job.inputs)
    with (
        alone_in(out),
        thread_scope(job.threads, opencv_alone=job.opencv_alone),
        started(job.executor) as executor,
    ):
        run = Run(replace(job, executor=executor), claim(out, job.kind, job.inputs))
        if isinstance(executor, Connection):
            threads = executor.num_threads()
            run.report("connect", threads, threads, f"dashboard: {executor.client.dashboard_link}")
        try:
            yield run
        except BaseException as error:
            run.note_end(error)
            with suppress(WorkspaceError, OSError):  # the first error is more informative
                run.folder.give_up(has_failed=isinstance(error, Exception))
                run.close()
            raise
        run.close()


def is_finished(out: Path, settings: Mapping[str, Any]) -> bool:
    """Whether a run with these settings has finished in this folder."""
    mark = read_mark(out)
    return mark is not None and mark.finished == digest(__version__, settings)
