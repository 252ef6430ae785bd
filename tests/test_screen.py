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
        "Doing [x]: started, 100 to do",
        "Doing [x]: 42 of 100, 42 %, about 14 s left",
        "Doing [x]: 84 of 100, 84 %, about 4 s left",
        "Doing [x]: 100 of 100 after 24.0 s",
    ]


def test_the_stage_that_compiles_says_what_it_compiles_and_that_it_happens_once(capsys, monkeypatch):
    clock = _jit._CompileClock()
    clock.count, clock.current = 12, "sift.orientations"
    monkeypatch.setattr(_jit, "_clock", clock)
    times = [0.0]
    monkeypatch.setattr(screen, "perf_counter", lambda: times[0])
    lines = screen._Lines(screen.open_console(stderr=True), {"compile": "Compiling kernels", "a": "Doing"})
    lines.show(Progress("a", 0, 3))
    lines.beat()
    lines.show(Progress("a", 3, 3))
    lines.show(Progress("compile", 0, 1))
    times[0] = 20.0
    lines.beat()
    lines.show(Progress("compile", 1, 1))
    assert capsys.readouterr().err.splitlines() == [
        "Doing: started, 3 to do",
        "Doing: 0 of 3, 0 % (12 kernels compiled, now sift.orientations), 0 s so far",
        "Doing: 3 of 3 after 0.0 s",
        "Compiling kernels: started; this happens once on this machine",
        "Compiling kernels: 12 kernels compiled, now sift.orientations, 20 s so far",
        "Compiling kernels: done after 20.0 s",
    ]


def test_stages_that_overlap_end_once_and_one_that_stops_early_ends_too(capsys, monkeypatch):
    reports = [("a", 0, 2), ("b", 0, 9), ("a", 2, 2), ("a", 2, 2), ("b", 4, 9), ("c", 0, 0)]
    assert lines_of(reports, capsys, 1.0, monkeypatch) == [
        "Doing [x]: started, 2 to do",
        "b: started, 9 to do",
        "Doing [x]: 2 of 2 after 2.0 s",
        "c: started, 0 to do",
        "b: 4 of 9 after 5.0 s",
    ]


def test_a_stage_that_runs_again_prints_all_its_lines_again(capsys, monkeypatch):
    once = [("a", k, 60) for k in range(61)]
    lines = lines_of([*once, ("b", 1, 1), *once], capsys, 0.25, monkeypatch)
    half = [
        "Doing [x]: started, 60 to do",
        "Doing [x]: 40 of 60, 66 %, about 5 s left",
        "Doing [x]: 60 of 60 after 15.0 s",
    ]
    assert lines == [*half, "b: 1 of 1 already done", *half]
    # in a row; stopped in its middle; done before, by another run; reported twice
    reports = [("a", 0, 2), ("a", 2, 2), ("a", 0, 3), ("a", 2, 3), ("a", 0, 3), ("a", 3, 3), ("b", 3, 3)]
    assert lines_of([*reports, ("a", 3, 3), ("a", 3, 3)], capsys, 1.0, monkeypatch) == [
        "Doing [x]: started, 2 to do",
        "Doing [x]: 2 of 2 after 1.0 s",
        "Doing [x]: started, 3 to do",
        "Doing [x]: 2 of 3 after 2.0 s",
        "Doing [x]: started, 3 to do",
        "Doing [x]: 3 of 3 after 1.0 s",
        "b: 3 of 3 already done",
        "Doing [x]: 3 of 3 already done",
    ]


def test_the_time_left_is_not_that_of_work_that_was_done_before(capsys, monkeypatch):
    lines = lines_of([("a", k, 100) for k in range(80, 95)], capsys, 1.0, monkeypatch)
    assert lines == [
        "Doing [x]: 80 of 100 already done",
        "Doing [x]: 90 of 100, 90 %, about 10 s left",
        "Doing [x]: 94 of 100 after 15.0 s",
    ]


def test_a_camera_that_has_no_end_is_still_told_of(capsys, monkeypatch):
    lines = lines_of([("a", k, k) for k in range(1, 24)], capsys, 1.0, monkeypatch)
    assert lines == ["Doing [x]: 1 of 1 already done", "Doing [x]: 11 so far", "Doing [x]: 21 so far"]


def test_notes_are_printed_whenever_they_come(capsys, monkeypatch):
    reports = [("a", 0, 9, "one"), ("a", 0, 9, "two [y]"), ("a", 9, 9, "three")]
    assert lines_of(reports, capsys, 1.0, monkeypatch) == [
        "Doing [x]: started, 9 to do; one",
        "Doing [x]: two [y]",
        "Doing [x]: three",
        "Doing [x]: 9 of 9 after 2.0 s",
    ]


def test_silent_work_prints_a_line_again_and_again(capsys, monkeypatch):
    monkeypatch.setattr(screen, "LINE_EVERY_S", 0.05)

    def wait_for(words):
        said, until = "", time.monotonic() + 5
        while words not in said and time.monotonic() < until:
            time.sleep(0.02)
            said += capsys.readouterr().err
        assert words in said

    with screen.progress_on_screen({"a": "Doing [x]"}) as show:
        wait_for("Working, ")
        show(Progress("a", 3, 7))
        wait_for("Doing [x]: 3 of 7, 42 %, 0 s so far")
        wait_for("Doing [x]: 3 of 7, 42 %, 0 s so far")
        show(Progress("a", 7, 7))
        wait_for("Working (last stage: Doing [x]), ")
    capsys.readouterr()
    with screen.loudness("quiet"), screen.progress_on_screen():
        time.sleep(0.2)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(screen, "SHORT_S", 0.01)
    with screen.working():
        wait_for("Working, 0 s so far")


def test_that_kernels_compile_is_said_once_something_works(capsys, monkeypatch):
    monkeypatch.setattr(_jit, "is_compiled", lambda: False)
    reports = [("a", 0, 1), ("a", 1, 1)]
    assert lines_of(reports, capsys, 1.0, monkeypatch, compiles_much=True).count(screen.COMPILE_NOTE) == 1
    assert lines_of([], capsys, 1.0, monkeypatch, compiles_much=True) == []


def test_quiet_and_verbose(capsys, monkeypatch):
    reports = [("a", k, 3) for k in range(4)]
    assert lines_of([("a", 3, 3)], capsys, 0.1, monkeypatch) == ["Doing [x]: 3 of 3 already done"]
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
    rendered = os.read(ours, 100_000).decode()
    os.close(ours)
    assert "━" in rendered and "3/3" in rendered and "started" not in rendered


@pytest.mark.parametrize("loudness", ["quiet", "normal"])
def test_short_waits(capsys, loudness, monkeypatch):
    with screen.loudness(loudness), screen.working():
        pass
    assert capsys.readouterr().err == ""  # over at once
    monkeypatch.setattr(screen, "SHORT_S", 0.05)
    with screen.loudness(loudness), screen.working():
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
