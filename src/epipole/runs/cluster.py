"""Connections to a cluster of Dask's `distributed`, or to one that is started for a run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from time import monotonic, sleep
from typing import Any, Protocol, runtime_checkable

from epipole._version import __version__
from epipole.errors import ConfigError, MissingDependencyError, WorkspaceError

WAIT_S = 0.2
ANSWER_S = 10.0
"""Time in which a worker must answer to be checked."""
FIRST_WORKER_S = 60.0
"""How long to wait for the first worker; a queue of Slurm may take any time."""


@dataclass(frozen=True, slots=True)
class Cluster:
    """Where the workers are."""

    address: str
    """Address of a scheduler (tcp://HOST:PORT or tls://HOST:PORT), `local:N` for N processes on this machine, or `slurm:N` for N jobs."""
    has_shared_folder: bool = True
    """Whether all machines see images and output folder under the same paths. If not, the files that a worker needs are sent to it."""

    def __post_init__(self) -> None:
        """Check the address.

        Raises:
            ConfigError: it has no known form.
        """
        kind, _, rest = self.address.partition(":")
        if kind in ("local", "slurm") and not (rest.isdecimal() and int(rest) > 0):
            raise ConfigError(f"the cluster {self.address!r} needs a number of workers, such as {kind}:4")
        if kind not in ("local", "slurm") and "://" not in self.address:
            raise ConfigError(
                f"the cluster {self.address!r} is no address: give tcp://HOST:PORT, tls://HOST:PORT, local:N or slurm:N"
            )


@runtime_checkable
class ClusterClient(Protocol):
    """What is used of a `distributed.Client`."""

    status: str

    def submit(self, function: Any, *args: Any, **options: Any) -> Any:
        """Run a function on a worker."""

    def scatter(self, data: Any, **options: Any) -> Any:
        """Send data to a worker."""

    def nthreads(self) -> dict[str, int]:
        """Threads of each worker."""


class Connection:
    """An open connection to a cluster."""

    def __init__(self, client: Any, *, has_shared_folder: bool, has_patience: bool = False) -> None:
        self.client = client
        """`distributed.Client`"""
        self.has_shared_folder = has_shared_folder
        self.has_patience = has_patience
        """Whether workers may appear at any time."""
        self.bytes_sent = self.bytes_received = 0
        """Content of files that was sent without a shared folder."""

    def num_threads(self) -> int:
        """Threads of all workers that are there now."""
        return sum(self.client.nthreads().values())


@contextmanager
def connected(cluster: Cluster) -> Iterator[Connection]:
    """Connect to a cluster, or start one that ends with the block.

    Raises:
        MissingDependencyError: `distributed` or, for Slurm, `dask-jobqueue` is not installed.
        WorkspaceError: no scheduler answers, or there is no worker.
    """
    distributed = _imported("distributed")
    kind, _, rest = cluster.address.partition(":")
    if kind == "local":
        with (
            distributed.LocalCluster(
                n_workers=int(rest),
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
            ) as local,
            distributed.Client(local, set_as_default=False) as client,
        ):
            yield joined(client, has_shared_folder=cluster.has_shared_folder)
    elif kind == "slurm":
        jobs = _imported("dask_jobqueue")
        with jobs.SLURMCluster() as queue, distributed.Client(queue, set_as_default=False) as client:
            queue.scale(jobs=int(rest))
            yield joined(client, has_shared_folder=cluster.has_shared_folder, has_patience=True)
    else:
        try:
            client = distributed.Client(cluster.address, timeout=FIRST_WORKER_S / 4, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:  # TypeError: tls:// without certificates
            raise WorkspaceError(f"no Dask scheduler answers at {cluster.address} ({error})") from error
        with client:
            yield joined(client, has_shared_folder=cluster.has_shared_folder)


def joined(client: Any, *, has_shared_folder: bool = True, has_patience: bool = False) -> Connection:
    """Wait for the first worker of a client, and check the versions of all.

    Raises:
        WorkspaceError: there is no worker, or one has another version of epipole or none.
    """
    connection = Connection(client, has_shared_folder=has_shared_folder, has_patience=has_patience)
    wait_for_workers(connection)
    for address, found in _versions_of_workers(client).items():
        version = found.get("packages", {}).get("epipole")
        if version != __version__:
            has = "no epipole" if version is None else f"epipole {version}"
            raise WorkspaceError(
                f"worker {address} has {has}, but this is epipole {__version__}: install the same version on every machine"
            )
    return connection


def _versions_of_workers(client: Any) -> dict[str, dict[str, Any]]:
    """Versions of the workers that answer soon: a silent one gets no work until it answers, and each chunk checks the version again."""
    from distributed.versions import get_versions  # there is a client, so it is installed

    ask = partial(client.submit, get_versions, ["epipole"], pure=False)
    asked = {address: ask(workers=[address]) for address in client.scheduler_info(n_workers=-1)["workers"]}
    end, found = monotonic() + ANSWER_S, dict[str, dict[str, Any]]()
    while len(found) < len(asked) and monotonic() < end:
        found |= {a: future.result() for a, future in asked.items() if a not in found and future.done()}
        sleep(WAIT_S)
    client.cancel([future for address, future in asked.items() if address not in found], force=True)
    return found


def wait_for_workers(connection: Connection) -> None:
    """Wait until there is a worker.

    Raises:
        WorkspaceError: none appears in time.
    """
    end = monotonic() + FIRST_WORKER_S
    while not connection.num_threads():
        if not connection.has_patience and monotonic() > end:
            raise WorkspaceError(
                f"the Dask scheduler has had no worker for {FIRST_WORKER_S:.0f} s; what is finished is kept"
            )
        sleep(WAIT_S)


def _imported(name: str) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingDependencyError(
            f"a cluster needs {name.replace('_', '-')}: pip install 'epipole[dask]'"
        ) from error
