"""The log of a run: rates and memory, continued by a run that goes on, and never a reason to stop."""

import re
import subprocess
import sys
import threading

import pytest

from epipole.runs import Job, Progress, open_run, run_log
from epipole.runs.run_log import RunLog


@pytest.fixture
def clock(monkeypatch):
    """Seconds that the test sets."""
    now = [100.0]
    monkeypatch.setattr(run_log, "perf_counter", lambda: now[0])
    return now


def lines_of(path):
    return path.read_text(encoding="utf-8").splitlines()


def test_a_line_has_time_stage_rate_rest_and_memory(tmp_path, clock, monkeypatch):
    monkeypatch.setattr(run_log, "memory_mb", lambda: 1234.4)
    log = RunLog(tmp_path / "log.txt")
    for done, seconds in ((0, 0.0), (10, 4.0), (30, 12.0), (31, 13.0), (100, 40.0)):
        clock[0] = 100.0 + seconds
        log.add(Progress("match", done, 100))
    first, later, last = lines_of(tmp_path / "log.txt")
    assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d  match +0 of 100 +1,234 MB$", first)
    assert "30 of 100, 2.5/s, 28 s left" in later and "100 of 100, 2.5/s " in last


def test_a_stage_that_starts_again_has_its_own_rate(tmp_path, clock):
    log = RunLog(tmp_path / "log.txt")
    for done, seconds in ((0, 0.0), (50, 1.0), (0, 2.0), (50, 12.0)):
        clock[0] = 100.0 + seconds
        log.add(Progress("map", done, 50))
    lines = lines_of(tmp_path / "log.txt")
    assert len(lines) == 3 and "50/s" in lines[1] and " 5/s" in lines[2]


def test_stages_that_alternate_write_few_lines(tmp_path, clock):
    log = RunLog(tmp_path / "log.txt")
    for n in range(100):
        clock[0] += 0.1
        log.add(Progress("map", n, 200))
        log.add(Progress("adjust", 0, 9))
    assert len(lines_of(tmp_path / "log.txt")) <= 4


def test_a_stream_of_unknown_length_writes_few_lines(tmp_path, clock):
    """Its total is the number of frames so far."""
    log = RunLog(tmp_path / "log.txt")
    for n in range(1, 601):
        clock[0] += 1 / 30
        log.add(Progress("track", n, n))
    lines = lines_of(tmp_path / "log.txt")
    assert len(lines) == 2 and "1 of 1" in lines[0] and "30/s" in lines[1]


def test_names_that_are_no_text_are_escaped(tmp_path):
    (tmp_path / "images").mkdir()
    with (
        pytest.raises(ValueError, match="cannot read"),
        open_run(job(tmp_path / "images"), tmp_path / "out") as run,
    ):
        (tmp_path / "out" / "work").mkdir()
        run.report("read", 0, 9, "bad\udcff.jpg")
        raise ValueError("cannot read bad\udcff.jpg")
    assert "bad\\udcff.jpg" in lines_of(tmp_path / "out" / "log.txt")[-1]


def test_a_link_of_that_name_is_not_followed(tmp_path):
    (tmp_path / "images").mkdir()
    with open_run(job(tmp_path / "images", has_log=False), tmp_path / "out") as run:
        run.finish({})
    (tmp_path / "out" / "log.txt").symlink_to(tmp_path / "elsewhere.txt")
    with open_run(job(tmp_path / "images"), tmp_path / "out") as run:
        run.finish({})
    assert not (tmp_path / "elsewhere.txt").exists()


def test_a_killed_run_without_results_leaves_the_folder_free(tmp_path):
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}.txt").write_text(name)
    kill = (
        "import os, sys; from pathlib import Path; from epipole.runs import Job, open_run\n"
        "job = Job(kind='reconstruct', inputs=(Path(sys.argv[1]),), settings={}, has_log=True)\n"
        "with open_run(job, Path(sys.argv[2])): os._exit(9)"
    )
    done = subprocess.run([sys.executable, "-c", kill, str(tmp_path / "first"), str(tmp_path / "out")])
    assert done.returncode == 9 and (tmp_path / "out" / "log.txt").exists()
    with open_run(job(tmp_path / "second"), tmp_path / "out") as run:
        run.finish({})


def test_notes_are_always_written_and_the_disk_never_stops_the_run(tmp_path, clock):
    log = RunLog(tmp_path / "log.txt")
    for done in range(3):
        log.add(Progress("map", done, 50, f"model {done}"))
    assert [line.split("; ")[1].split("  ")[0] for line in lines_of(tmp_path / "log.txt")] == [
        "model 0",
        "model 1",
        "model 2",
    ]
    RunLog(tmp_path / "missing" / "log.txt").add(Progress("map", 0, 50))
    assert not (tmp_path / "missing").exists()


def job(source, *, has_log=True):
    return Job(kind="reconstruct", inputs=(source,), settings={}, has_log=has_log)


def test_a_stopped_run_says_why_and_the_next_one_continues_the_log(tmp_path):
    (tmp_path / "images").mkdir()
    out = tmp_path / "out"
    with pytest.raises(KeyError), open_run(job(tmp_path / "images"), out) as run:
        run.report("match", 0, 9)
        (out / "work").mkdir()  # what the next run continues from
        raise KeyError("lost")
    with open_run(job(tmp_path / "images"), out) as run:
        with run.stage("match"):
            run.report("match", 9, 9)
        run.finish({})
    words = [line.split("  ", 1)[1].split()[0] for line in lines_of(out / "log.txt")]
    assert words == ["started", "match", "stopped", "started", "match", "match", "finished"]
    assert "KeyError: 'lost'" in lines_of(out / "log.txt")[2]
    with open_run(job(tmp_path / "images"), out) as run:
        run.finish({})
    assert (
        len(lines_of(out / "log.txt")) == 9
    )  # also after a finished run, whose result stays if this one fails


def test_a_run_without_results_leaves_no_log(tmp_path):
    (tmp_path / "images").mkdir()
    with pytest.raises(KeyError), open_run(job(tmp_path / "images"), tmp_path / "out") as run:
        run.report("read", 0, 9)
        raise KeyError("lost")
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_a_file_of_that_name_that_is_not_ours_is_kept(tmp_path):
    (tmp_path / "images").mkdir()
    out = tmp_path / "out"
    with open_run(job(tmp_path / "images", has_log=False), out) as run:
        run.finish({})
    (out / "log.txt").write_text("mine")
    with open_run(job(tmp_path / "images"), out) as run:
        run.report("match", 0, 9)
        run.finish({})
    assert (out / "log.txt").read_text() == "mine"


def test_threads_write_whole_lines(tmp_path):
    log = RunLog(tmp_path / "log.txt")
    threads = [
        threading.Thread(target=lambda: [log.add(Progress("match", n, 99, "note")) for n in range(50)])
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    lines = lines_of(tmp_path / "log.txt")
    assert len(lines) == 200 and all(" of 99" in line for line in lines)
