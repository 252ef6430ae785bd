"""A run: times that add up, threads that are put back, and whether it has finished."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from epipole import _parallel
from epipole.runs import Job, Unit, digest, is_finished, open_run
from epipole.runs.threads import opencv_in_one_thread, thread_scope


def job(tmp_path: Path, **options: object) -> Job:
    return Job(kind="made", inputs=(tmp_path,), settings={"a": 1}, **options)


def one(payload: int) -> dict[str, np.ndarray]:
    return {"value": np.array(payload)}


def units(folder: Path, count: int) -> list[Unit]:
    return [Unit(folder / f"{n}.npz", digest(n), one, n) for n in range(count)]


def test_a_finished_run_says_so_until_another_begins(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with open_run(job(tmp_path), out) as run:
        assert not is_finished(out, {"a": 1})
        run.finish({"num": 3})
    assert is_finished(out, {"a": 1}) and not is_finished(out, {"a": 2})
    assert {"config.json", "summary.json"} <= {p.name for p in out.iterdir()}
    with pytest.raises(KeyboardInterrupt), open_run(job(tmp_path), out):
        raise KeyboardInterrupt
    assert not is_finished(out, {"a": 1})


def test_a_resumed_run_adds_to_the_times_of_the_one_before(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt), open_run(job(tmp_path), out) as run, run.stage("features"):
            run.folder.write_text("kept.txt", "x")
            time.sleep(0.05)
            raise KeyboardInterrupt
    with open_run(job(tmp_path), out) as run:
        with run.stage("features"):
            pass
        assert 0.1 <= run.timings_s["features"] < 5.0
        run.finish()
    with open_run(job(tmp_path), out) as run, run.stage("features"):  # a new count after a finished one
        pass
    assert run.timings_s["features"] < 0.05


def test_units_of_a_finished_run_bring_their_seconds(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with open_run(job(tmp_path, executor="inline"), out) as run:
        with run.stage("features"):
            run.do(units(out / "work", 2), "features")
            time.sleep(0.05)
        run.finish()
    with open_run(job(tmp_path, executor="inline"), out) as run, run.stage("features"):
        run.do(units(out / "work", 2), "features")
    assert run.timings_s["features"] >= 0.05


@pytest.mark.parametrize("fails", [False, True])
def test_threads_are_put_back(fails: bool) -> None:
    before = cv2.getNumThreads(), _parallel.requested_threads()
    try:
        with thread_scope(1, opencv_alone=True):
            assert cv2.getNumThreads() == 1 and _parallel.num_threads() == 1
            with opencv_in_one_thread():
                pass
            assert cv2.getNumThreads() == 1  # the outer one is still at work
            if fails:
                raise ZeroDivisionError
    except ZeroDivisionError:
        pass
    assert (cv2.getNumThreads(), _parallel.requested_threads()) == before
