"""An executor of the user's does the units of a reconstruction, as Dask's or Ray's would."""

import os
import pickle
import signal
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from epipole import reconstruct
from epipole.pipelines.sfm.run import ReconstructionResult
from epipole.runs import Progress
from whole import in_whole_run


class Elsewhere(Executor):
    """Takes everything there and back as bytes, as an executor on other machines does; knows `submit` alone."""

    def __init__(self) -> None:
        self.num_tasks, self.is_shut, self._pool = 0, False, ThreadPoolExecutor(2)

    def submit(self, function: Callable, /, *args: object, **kwargs: object) -> Future:
        """Run function(*args) of copies, and give a copy of its result."""
        self.num_tasks += 1
        task = pickle.dumps((function, args, kwargs))

        def run() -> bytes:
            there, arguments, named = pickle.loads(task)
            return pickle.dumps(there(*arguments, **named))

        future: Future = Future()
        self._pool.submit(run).add_done_callback(lambda done: _hand_over(done, future))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Note it: whoever was given an executor leaves it open."""
        self.is_shut = True
        self._pool.shutdown(wait, cancel_futures=cancel_futures)


def _hand_over(done: Future, future: Future) -> None:
    if error := done.exception():
        future.set_exception(error)
    else:
        future.set_result(pickle.loads(done.result()))


@pytest.fixture(scope="module")
def here(few: Path, tmp_path_factory: pytest.TempPathFactory, two_threads: None) -> ReconstructionResult:
    """The reconstruction by threads of this process, which no test changes."""
    return reconstruct(few, tmp_path_factory.mktemp("executor") / "here")


def test_the_same_bytes_from_an_executor_of_the_users(
    few: Path, here: ReconstructionResult, tmp_path: Path
) -> None:
    executor = Elsewhere()
    there = reconstruct(few, tmp_path / "there", executor=executor)
    assert executor.num_tasks >= 4 + 1 + 1  # an image each, and blocks of pairs
    assert not executor.is_shut
    assert here.summary["num_registered"] == there.summary["num_registered"] == 4
    files = sorted(p.relative_to(here.out) for p in (here.out / "sparse").rglob("*.bin"))
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= {path.name for path in files}
    for name in [*files, Path("points.ply")]:
        assert (here.out / name).read_bytes() == (there.out / name).read_bytes(), name
    executor.shutdown()


def same_files(here: Path, there: Path) -> None:
    """The same results of every stage; only what contains times differs."""
    files = sorted(p.relative_to(here) for p in here.rglob("*") if p.is_file() and p.parts[-1][0] != ".")
    timed = {"summary.json", "report.html", "epipole.json", "config.json", "log.txt"}
    assert len([path for path in files if path.suffix == ".npz"]) >= 4 + 1 + 1
    for name in files:
        if name.name not in timed:
            assert (here / name).read_bytes() == (there / name).read_bytes(), name


@in_whole_run
def test_the_same_bytes_from_a_cluster_without_a_shared_folder(
    few: Path, here: ReconstructionResult, tmp_path: Path
) -> None:
    pytest.importorskip("distributed")
    reports = []
    there = reconstruct(
        few, tmp_path / "there", progress=reports.append, cluster="local:2", shared_folder=False
    )
    same_files(here.out, there.out)
    assert any(report.stage == "connect" and "http" in report.note for report in reports)


def test_the_same_bytes_from_a_cluster_that_loses_a_worker(
    few: Path, here: ReconstructionResult, tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed")
    killed = []
    with (
        distributed.LocalCluster(
            2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as local,
        distributed.Client(local, set_as_default=False) as client,
    ):
        processes = list(client.run(os.getpid).values())

        def kill(report: Progress) -> None:
            if report.stage == "features" and report.done == 1 and not killed:
                killed.append(os.kill(processes[0], signal.SIGKILL))

        there = reconstruct(few, tmp_path / "there", progress=kill, executor=client)
        assert client.status == "running"
    assert killed
    same_files(here.out, there.out)


def test_an_error_elsewhere_reaches_the_caller(few: Path, tmp_path: Path) -> None:
    class Broken(Elsewhere):
        def submit(self, function: Callable, /, *args: object, **kwargs: object) -> Future:
            future: Future = Future()
            future.set_exception(ConnectionError("the scheduler has gone"))
            return future

    with pytest.raises(ConnectionError, match="the scheduler has gone"):
        reconstruct(few, tmp_path / "out", executor=Broken())
