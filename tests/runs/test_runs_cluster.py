"""Units on a cluster of two processes: the same files, whatever happens to workers, and clear errors."""

import os
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from epipole.errors import ConfigError, FileFormatError, MissingDependencyError, WorkspaceError
from epipole.runs import Cluster, Unit, cluster, cluster_dispatch, digest, executors, run_units
from epipole.runs.cluster import Connection, connected, joined
from epipole.runs.cluster_work import RemoteFile, run_chunk
from epipole.runs.payloads import files_in, with_paths
from whole import IS_WHOLE

distributed = pytest.importorskip("distributed")


@dataclass(frozen=True)
class Task:
    path: Path
    seconds: float = 0.02


def doubled(task: Task) -> dict[str, np.ndarray]:
    time.sleep(task.seconds)
    if not task.path.exists():
        raise FileFormatError(task.path, "it does not exist")
    return {"value": np.array(2 * int(task.path.read_text()))}


@pytest.fixture(scope="module")
def client() -> Iterator[Any]:
    """A client of two workers, which get this module's functions by value."""
    import cloudpickle

    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    with (
        distributed.LocalCluster(
            2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as local,
        distributed.Client(local, set_as_default=False) as client,
    ):
        yield client


@pytest.fixture
def connection(client: Any) -> Connection:
    return joined(client)


def tasks(folder: Path, count: int = 24, seconds: float = 0.02) -> list[Unit]:
    """Units that double the number in a file."""
    inputs = folder.with_name("inputs")
    inputs.mkdir(exist_ok=True, parents=True)
    for n in range(count):
        (inputs / f"{n}.txt").write_text(str(n))
    return [
        Unit(folder / f"{n}.npz", digest(n), doubled, Task(inputs / f"{n}.txt", seconds))
        for n in range(count)
    ]


def contents(folder: Path) -> dict[str, bytes]:
    """The results; a worker that was killed may leave an unfinished file beside them."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.name[0] != "."}


@pytest.fixture
def expected(tmp_path: Path) -> dict[str, bytes]:
    run_units(tasks(tmp_path / "here"), stage="s", executor="inline")
    return contents(tmp_path / "here")


@pytest.mark.parametrize("is_shared", [False] + IS_WHOLE * [True])
def test_the_files_are_those_of_this_process(
    client: Any, tmp_path: Path, expected: dict[str, bytes], is_shared: bool
) -> None:
    connection = joined(client, has_shared_folder=is_shared)
    reports: list[Any] = []
    units = tasks(tmp_path / "there")
    assert run_units(units, stage="s", executor=connection, progress=reports.append) == 24
    assert contents(tmp_path / "there") == expected
    assert [r.done for r in reports] == list(range(25))
    if is_shared:
        assert connection.bytes_sent == connection.bytes_received == 0
    else:
        assert connection.bytes_sent == sum(len(str(n)) for n in range(24))  # each file once
        assert connection.bytes_received == sum(map(len, expected.values()))
    assert run_units(units, stage="s", executor=connection) == 0


@pytest.mark.parametrize("is_shared", [True] + IS_WHOLE * [False])
def test_a_worker_that_is_killed_costs_nothing_but_time(
    client: Any, tmp_path: Path, expected: dict[str, bytes], is_shared: bool
) -> None:
    connection = joined(client, has_shared_folder=is_shared)
    victim = next(iter(client.run(os.getpid).values()))
    done = 0
    for size in cluster_dispatch.run_on_cluster(connection, tasks(tmp_path / "there", seconds=0.1)):
        done += size
        if done == 4:
            os.kill(victim, signal.SIGKILL)
    assert done == 24 and contents(tmp_path / "there") == expected


def test_a_worker_that_is_frozen_delays_nothing(
    connection: Connection, tmp_path: Path, expected: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster_dispatch, "SLOW_S", 0.5)
    connection.client.wait_for_workers(2)
    victim = next(iter(connection.client.run(os.getpid).values()))
    done, start = 0, time.monotonic()
    try:
        for size in cluster_dispatch.run_on_cluster(connection, tasks(tmp_path / "there", seconds=0.05)):
            done += size
            if done == 4:
                os.kill(victim, signal.SIGSTOP)
    finally:
        os.kill(victim, signal.SIGCONT)
    assert done == 24 and contents(tmp_path / "there") == expected
    assert time.monotonic() - start < 20


def test_a_worker_that_is_frozen_at_the_start_is_not_waited_for(
    client: Any, tmp_path: Path, expected: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster_dispatch, "SLOW_S", 0.5)
    monkeypatch.setattr(cluster, "ANSWER_S", 1.0)
    client.wait_for_workers(2)
    victim, start = next(iter(client.run(os.getpid).values())), time.monotonic()
    os.kill(victim, signal.SIGSTOP)
    try:
        run_units(tasks(tmp_path / "there"), stage="s", executor=joined(client))
    finally:
        os.kill(victim, signal.SIGCONT)
    assert contents(tmp_path / "there") == expected
    assert time.monotonic() - start < 20


def test_paths_with_dots_stay_in_the_folder_of_the_worker(client: Any, tmp_path: Path) -> None:
    unit = tasks(tmp_path / "there", 1)[0]
    path = tmp_path / "not" / "there" / ".." / ".." / "inputs" / "0.txt"
    dotted = Unit(unit.path, unit.key, doubled, Task(Path(os.path.relpath(path))))
    (tmp_path / "not" / "there").mkdir(parents=True)
    connection = joined(client, has_shared_folder=False)
    assert list(cluster_dispatch.run_on_cluster(connection, [dotted])) == [1]
    assert connection.bytes_sent == 1


def test_an_error_of_a_unit_reaches_the_caller(connection: Connection, tmp_path: Path) -> None:
    units = tasks(tmp_path / "there")
    missing = Unit(tmp_path / "there" / "x.npz", "x", doubled, Task(tmp_path / "inputs" / "none.txt"))
    with pytest.raises(FileFormatError, match=r"none\.txt"):
        run_units([*units, missing], stage="s", executor=connection)


def test_machines_without_a_shared_folder_are_noticed(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same path leads to another folder there."""
    monkeypatch.setattr(cluster_dispatch, "SHARED_FOLDER_S", 0.3)
    connection, before = joined(client), Path.cwd()
    client.wait_for_workers(2)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    unit = tasks(tmp_path / "there", 1)[0]
    units = [Unit(Path("/proc/self/cwd/result.npz"), unit.key, unit.work, unit.payload)]
    client.run(os.chdir, str(elsewhere))
    monkeypatch.chdir(tmp_path)
    try:
        with pytest.raises(WorkspaceError, match="--no-shared-folder"):
            list(cluster_dispatch.run_on_cluster(connection, units))
    finally:
        client.run(os.chdir, str(before))


def test_another_version_is_refused(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(WorkspaceError, match=r"comes from 0\.0\.1"):
        run_chunk("0.0.1", (), [], [], True)
    monkeypatch.setattr(cluster, "__version__", "0.0.1")
    with pytest.raises(WorkspaceError, match=r"but this is epipole 0\.0\.1"):
        joined(client)
    monkeypatch.setattr(cluster, "_versions_of_workers", lambda _: {"tcp://a:1": {"packages": {}}})
    with pytest.raises(WorkspaceError, match="has no epipole"):
        joined(client)


@pytest.mark.parametrize("address", ["", "localhost", "local", "local:0", "local:x", "slurm:", "slurm:-1"])
def test_addresses_of_no_known_form_are_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="cluster"):
        Cluster(address)


def test_where_no_scheduler_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "FIRST_WORKER_S", 0.4)
    with (
        pytest.raises(WorkspaceError, match="no Dask scheduler answers"),
        connected(Cluster("tcp://127.0.0.1:1")),
    ):
        pass


def test_without_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "FIRST_WORKER_S", 0.4)
    with (
        distributed.LocalCluster(1, processes=False, dashboard_address="127.0.0.1:0") as local,
        distributed.Client(local, set_as_default=False) as client,
    ):
        local.scale(0)
        while client.scheduler_info()["workers"]:
            time.sleep(0.01)
        with pytest.raises(WorkspaceError, match="no worker"):
            joined(client)


def test_a_lost_scheduler_is_an_error_and_the_finished_results_stay(tmp_path: Path) -> None:
    with distributed.LocalCluster(1, processes=False, dashboard_address="127.0.0.1:0") as local:
        client = distributed.Client(local, set_as_default=False)
        done = 0
        with pytest.raises(WorkspaceError, match="run the command again"):
            for size in cluster_dispatch.run_on_cluster(joined(client), tasks(tmp_path / "there")):
                done += size
                if done == 5:
                    local.close()
        assert len(list((tmp_path / "there").iterdir())) >= 5
        client.close()
    assert run_units(tasks(tmp_path / "there"), stage="s", executor="inline") <= 19


def test_a_queue_of_slurm_is_scaled_and_awaited(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    scaled = []

    class Queue:
        def __enter__(self) -> Any:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def scale(self, jobs: int) -> None:
            scaled.append(jobs)

    class Borrowed:
        """The client of these tests, which stays open."""

        def __init__(self, queue: object, set_as_default: bool) -> None:
            assert isinstance(queue, Queue)

        def __enter__(self) -> Any:
            return client

        def __exit__(self, *_: object) -> None:
            pass

    monkeypatch.setattr(
        cluster, "_imported", lambda name: type("M", (), {"SLURMCluster": Queue, "Client": Borrowed})
    )
    with connected(Cluster("slurm:7")) as connection:
        assert connection.has_patience and connection.num_threads() == 2
    assert scaled == [7]


def test_a_missing_package_names_the_extra() -> None:
    with pytest.raises(MissingDependencyError, match=r"epipole\[dask\]"):
        cluster._imported("no_such_package")


def test_a_local_cluster_starts_and_ends_with_the_run(tmp_path: Path) -> None:
    with executors.started(Cluster("local:1")) as connection:
        assert isinstance(connection, Connection) and connection.num_threads() == 1
        with executors.opened(connection) as pool:
            assert pool is connection
    assert connection.client.status == "closed"
    with executors.started("threads") as choice:
        assert choice == "threads"


def test_paths_are_found_and_replaced_wherever_they_are(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for name in ("a", "folder/b", "folder/c"):
        (tmp_path / name).write_text(name)
    value = {1: [Task(tmp_path / "a")], 2: (tmp_path / "folder", "text", np.zeros(2)), 3: None}
    assert [p.name for p in files_in(value)] == ["a", "b", "c"]
    moved = with_paths(value, lambda path: Path("/there") / path.name)
    assert moved[1][0].path == Path("/there/a") and moved[2][0] == Path("/there/folder")
    assert moved[2][2] is value[2][2] and value[1][0].path == tmp_path / "a"
    row = RemoteFile(b"x")
    assert with_paths(row, lambda path: path).content == b"x"
