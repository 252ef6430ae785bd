"""What commands print while they work: bars on a terminal, few lines in a log file."""

import os
import pty
import subprocess
import sys
import time

import pytest
from rich.console import Console

from epipole import _jit, screen
from epipole.runs import Progress

SPEAK = """
from epipole.runs import Progress
from epipole.screen import progress_on_screen
with progress_on_screen({"a": "Doing [x]"}) as show:
    for k in range(4):
        show(Progress("a", k, 3))
"""


def lines_of(reports, capsys, seconds_each, monkeypatch, **options):
    clock = [0.0]
    monkeypatch.setattr(screen, "perf_counter", lambda: clock[0])
    with screen.progress_on_screen({"a": "Doing [x]"}, **options) as show:
        for report in reports:
            show(Progress(*report))
            clock[0] += seconds_each
    said = capsys.readouterr()
    assert said.out == ""
    return said.err.splitlines()


def test_a_log_gets_a_line_at_the_begin_at_the_end_and_every_ten_seconds(capsys, monkeypatch):
    reports = [("a", k, 100) for k in range(101)]
    assert lines_of(reports, capsys, 0.24, monkeypatch) == [
        "Doing [x]: begins, 100 to do",
        "Doing [x]: 42 of 100, 42 %, about 14 s left",
        "Doing [x]: 84 of 100, 84 %, about 4 s left",
        "Doing [x]: 100 of 100 after 24.0 s",
    ]


def test_stages_that_overlap_end_once_and_one_that_stops_early_ends_too(capsys, monkeypatch):
    reports = [("a", 0, 2), ("b", 0, 9), ("a", 2, 2), ("a", 2, 2), ("b", 4, 9), ("c", 0, 0)]
    assert lines_of(reports, capsys, 1.0, monkeypatch) == [
        "Doing [x]: begins, 2 to do",
        "b: begins, 9 to do",
        "Doing [x]: 2 of 2 after 2.0 s",
        "c: begins, 0 to do",
        "b: 4 of 9 after 5.0 s",
    ]


def test_that_kernels_compile_is_said_once_something_works(capsys, monkeypatch):
    monkeypatch.setattr(_jit, "is_compiled", lambda: False)
    reports = [("a", 0, 1), ("a", 1, 1)]
    assert lines_of(reports, capsys, 1.0, monkeypatch, compiles_much=True).count(screen.COMPILE_NOTE) == 1
    assert lines_of([], capsys, 1.0, monkeypatch, compiles_much=True) == []


def test_quiet_and_verbose(capsys, monkeypatch):
    reports = [("a", k, 3) for k in range(4)]
    assert lines_of([("a", 3, 3)], capsys, 0.1, monkeypatch) == ["Doing [x]: 3 of 3 are done"]
    with screen.loudness("quiet"):
        assert lines_of(reports, capsys, 0.1, monkeypatch) == []
    with screen.loudness("verbose"):
        assert len(lines_of(reports, capsys, 0.1, monkeypatch)) == 4


def test_lines_are_written_at_once_and_bars_only_on_a_terminal():
    with subprocess.Popen(
        [sys.executable, "-c", SPEAK + "import os; os._exit(0)"], stderr=subprocess.PIPE, text=True
    ) as running:  # _exit: nothing is flushed any more
        assert "Doing [x]: 3 of 3 after" in running.stderr.read()
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "100"}
    subprocess.run([sys.executable, "-c", SPEAK], stderr=theirs, env=environment, check=True, timeout=60)
    os.close(theirs)
    drawn = os.read(ours, 100_000).decode()
    os.close(ours)
    assert "━" in drawn and "3/3" in drawn and "begins" not in drawn


@pytest.mark.parametrize("loudness", ["quiet", "normal"])
def test_short_waits(capsys, loudness, monkeypatch):
    with screen.loudness(loudness), screen.waiting_for_kernels():
        pass
    assert capsys.readouterr().err == ""  # over at once
    monkeypatch.setattr(screen, "SHORT_S", 0.05)
    with screen.loudness(loudness), screen.waiting_for_kernels():
        time.sleep(0.2)
    said = capsys.readouterr().err
    assert said == "" if loudness == "quiet" else said.startswith("Working") and "Done after 0.2 s" in said


def test_warnings_that_are_not_printed_are_counted(capsys):
    console = Console(width=200)
    screen.print_warnings(console, [f"[w] {k}" for k in range(14)], rest_in="OUT/summary.json")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 11 and lines[0] == "note: [w] 0" and lines[-1] == "note: 4 more, in OUT/summary.json"
    screen.print_warnings(console, map(str, range(11)), rest_in="OUT/summary.json")
    screen.print_warnings(console, map(str, range(14)))
    assert len(capsys.readouterr().out.splitlines()) == 25
