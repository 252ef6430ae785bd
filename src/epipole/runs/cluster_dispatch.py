"""Units of work on the workers of a cluster.

This process sends each piece of work itself and keeps a few in flight per worker, so that a slow worker gets fewer and a lost one costs
those that it had. Results are files: in a folder that all machines share, or sent back and written here.
"""

from __future__ import annotations

import math
import statistics
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from epipole._version import __version__
from epipole.errors import EpipoleError, WorkspaceError
from epipole.io.atomic import atomic_write
from epipole.runs.cluster import Connection, wait_for_workers
from epipole.runs.cluster_work import RemoteFile, run_chunk
from epipole.runs.payloads import files_in, with_paths
from epipole.runs.units import Unit, is_done

IN_FLIGHT = 2
"""Chunks per thread of the cluster that are sent at the same time."""
CHUNK_BYTES, CHUNK_UNITS, LEAST_CHUNKS = 16_000_000, 16, 8
"""Most bytes of files and most units in a chunk of several units, and least chunks per thread."""
WAIT_S, FETCH_S = 1.0, 10.0
SHARED_FOLDER_S = 10.0
"""How long to wait for a file that a worker has written: network folders show it late."""
SLOW_FACTOR, SLOW_S = 4.0, 10.0
"""When nothing waits, a chunk that takes this multiple of the median, and longer than this, runs on another worker too."""
SILENT_S = 4.0
"""Time after which a worker that the scheduler has not heard from counts as silent; one that lives is heard several times."""
HEARTBEATS = 3.0
"""Times between the reports of a worker that make it silent, as they grow with the number of workers: by a second for 200."""
MAX_ATTEMPTS = 4
LOST = "the connection to the Dask scheduler is lost; what is finished is kept: run the command again"


@dataclass(slots=True, eq=False)
class _Chunk:
    """Units that are sent together."""

    units: tuple[Unit, ...]
    files: tuple[Path, ...]
    """Files that they read."""
    num_attempts: int = 0
    since: float = 0.0
    is_repeated: bool = False
    futures: list[Any] = field(default_factory=list)


def run_on_cluster(connection: Connection, units: Sequence[Unit]) -> Iterator[int]:
    """Run units on the workers; yields the size of each when its result is here.

    Raises:
        WorkspaceError: the scheduler or all workers are lost, a unit ends several workers, or its result does not arrive.
    """
    dispatch = _Dispatch(connection, units)
    try:
        while dispatch.chunks or dispatch.running:
            dispatch.send()
            for unit in dispatch.received():
                yield unit.size
    except OSError as error:
        if isinstance(error, EpipoleError) or connection.client.status == "running":
            raise
        raise WorkspaceError(LOST) from error
    finally:
        dispatch.cancel([f for chunk in dispatch.running for f in chunk.futures])


class _Dispatch:
    """The chunks that wait and those that were sent."""

    def __init__(self, connection: Connection, units: Sequence[Unit]) -> None:
        self.connection, self.client = connection, connection.client
        self.num_threads = max(connection.num_threads(), 1)
        self.chunks = deque(_chunks_of(units, LEAST_CHUNKS * self.num_threads))
        self.running: list[_Chunk] = []
        self._durations_s: list[float] = []
        self._has_ended = threading.Event()
        self._looked = -math.inf
        self._silent: set[str] = set()
        self._others: list[str] = []
        self._sent = _SentFiles(connection, self.chunks)

    def send(self) -> None:
        """Send chunks until enough are in flight; when none waits, repeat the slow ones."""
        self.num_threads = self._threads()
        self._look_for_silent_workers()
        while self.chunks and len(self.running) < IN_FLIGHT * self.num_threads:
            chunk = self.chunks.popleft()
            chunk.num_attempts, chunk.since = chunk.num_attempts + 1, monotonic()
            chunk.futures = [self._submit(chunk)]
            self.running.append(chunk)
        if not self.chunks:
            self._repeat_slow()

    def _threads(self) -> int:
        if self.client.status != "running":
            raise WorkspaceError(LOST)
        if not (found := self.connection.num_threads()):
            wait_for_workers(self.connection)
            found = self.connection.num_threads()
        return max(found, 1)

    def _submit(self, chunk: _Chunk, workers: Sequence[str] | None = None) -> Any:
        """Send a chunk to any of these workers; by default to any that is not silent."""
        workers = self._others if workers is None and self._silent else workers
        where = {"workers": list(workers), "allow_other_workers": True} if workers else {}
        shared = self.connection.has_shared_folder
        units = with_paths(chunk.units, Path.absolute)
        names = [] if shared else [str(path) for path in chunk.files]
        files = [] if shared else [self._sent.future_of(path, self._others) for path in chunk.files]
        future = self.client.submit(
            run_chunk, __version__, units, names, files, shared, pure=False, retries=0, **where
        )
        future.add_done_callback(lambda _: self._has_ended.set())
        return future

    def _look_for_silent_workers(self) -> None:
        """Workers that the scheduler has not heard from, though it has from others, get no further work."""
        if monotonic() - self._looked < WAIT_S:
            return
        self._looked = monotonic()
        workers = self.client.scheduler_info(n_workers=-1)["workers"]
        heard = {address: worker["last_seen"] for address, worker in workers.items()}
        newest = max(heard.values(), default=0.0)
        limit_s = SILENT_S + HEARTBEATS * len(heard) / 200.0
        self._silent = {address for address, time_s in heard.items() if newest - time_s > limit_s}
        self._others = [address for address in heard if address not in self._silent]

    def _repeat_slow(self) -> None:
        """Run chunks that take long, or that a silent worker has, on another worker too; both write the same file."""
        limit_s = SLOW_FACTOR * statistics.median(self._durations_s) if self._durations_s else math.inf
        slow = [
            chunk
            for chunk in self.running
            if not chunk.is_repeated and (self._silent or monotonic() - chunk.since > max(SLOW_S, limit_s))
        ]
        workers_of = self.client.processing() if slow else {}
        for chunk in slow:
            own = {future.key for future in chunk.futures}
            busy = {address for address, keys in workers_of.items() if own & set(keys)}
            others = [address for address in self._others if address not in busy]
            if others and (busy & self._silent or monotonic() - chunk.since > max(SLOW_S, limit_s)):
                chunk.is_repeated = True
                chunk.futures.append(self._submit(chunk, others))

    def received(self) -> Iterator[Unit]:
        """Wait a moment; the units of the chunks that have ended, whose results are here."""
        self._has_ended.wait(WAIT_S)
        self._has_ended.clear()
        for chunk in list(self.running):
            done = [future for future in chunk.futures if future.done()]
            if not done:
                continue
            ended = next((future for future in done if future.status == "finished"), done[0])
            self.running.remove(chunk)
            try:
                contents = ended.result() if ended.status == "finished" else None
            except Exception:
                if ended.status == "finished":
                    raise
                contents = None  # the result was lost with its worker just now
            if contents is None:
                self._fail(chunk, ended)
                continue
            self._durations_s.append(monotonic() - chunk.since)
            self._accept(chunk, contents)
            self.cancel([future for future in chunk.futures if future is not ended])
            yield from chunk.units

    def _accept(self, chunk: _Chunk, contents: list[bytes | None]) -> None:
        """Write the results here, or see that they are here."""
        for unit, content in zip(chunk.units, contents):
            if content is not None:
                self.connection.bytes_received += len(content)
                with atomic_write(unit.path) as aside:
                    aside.write_bytes(content)
            elif not _appears(unit):
                raise WorkspaceError(
                    f"a worker has written {unit.path}, but it is not here: the machines share no folder under this path;"
                    " use --no-shared-folder"
                )
        self._sent.release(chunk)

    def cancel(self, futures: Sequence[Any]) -> None:
        """Cancel futures, as far as the scheduler can be reached."""
        if futures and self.client.status == "running":
            with suppress(OSError):
                self.client.cancel(list(futures), force=True)

    def _fail(self, chunk: _Chunk, future: Any) -> None:
        """Send a chunk again whose worker or files were lost; raise any other error."""
        from distributed.scheduler import KilledWorker

        # Without an error, the worker that had its files or its result is gone.
        error = future.exception(timeout=FETCH_S) if future.status == "error" else None
        if isinstance(error, KilledWorker):
            names = ", ".join(unit.path.name for unit in chunk.units[:3])
            raise WorkspaceError(
                f"several workers died one after the other at the same work ({names}): probably out of memory"
            ) from error
        if error is not None:
            raise _in_words(error) from error
        if chunk.num_attempts >= MAX_ATTEMPTS:
            raise WorkspaceError(
                f"the same work was lost on the cluster {chunk.num_attempts} times; what is finished is kept"
            )
        self._sent.remove(chunk)
        self.cancel([other for other in chunk.futures if other is not future])
        chunk.is_repeated = False
        self.chunks.appendleft(chunk)


class _SentFiles:
    """Files that were sent to the cluster, until no chunk needs them any more."""

    def __init__(self, connection: Connection, chunks: Sequence[_Chunk]) -> None:
        self.connection = connection
        self._futures: dict[Path, Any] = {}
        self._num_needed: dict[Path, int] = {}
        for chunk in () if connection.has_shared_folder else chunks:
            for path in chunk.files:
                self._num_needed[path] = self._num_needed.get(path, 0) + 1

    def future_of(self, path: Path, workers: Sequence[str]) -> Any:
        """The file's content on the cluster; sent to one of the workers that are heard, if it is not there yet."""
        if path not in self._futures:
            content = path.read_bytes()
            self.connection.bytes_sent += len(content)
            self._futures[path] = self._scattered(RemoteFile(content), workers)
        return self._futures[path]

    def _scattered(self, file: RemoteFile, workers: Sequence[str]) -> Any:
        """Send a file to a worker, and to another one if that worker is just being lost."""
        client = self.connection.client
        for _ in range(MAX_ATTEMPTS - 1):
            with suppress(OSError, KeyError):
                return client.scatter(file, workers=list(workers) or None, hash=False)
            sleep(WAIT_S)
            workers = ()
        return client.scatter(file, hash=False)

    def release(self, chunk: _Chunk) -> None:
        """The chunk has its result."""
        for path in [] if self.connection.has_shared_folder else chunk.files:
            self._num_needed[path] -= 1
            if self._num_needed[path] == 0:
                self._futures.pop(path, None)

    def remove(self, chunk: _Chunk) -> None:
        """The chunk's files may be lost with their worker."""
        for path in chunk.files:
            self._futures.pop(path, None)


def _chunks_of(units: Sequence[Unit], least: int) -> Iterator[_Chunk]:
    """Consecutive units, divided by the bytes of their files."""
    files = [files_in(unit.payload) for unit in units]
    sizes = [sum(path.stat().st_size for path in own) for own in files]
    most_bytes = min(CHUNK_BYTES, sum(sizes) / max(least, 1))
    most_units = min(CHUNK_UNITS, -(-len(units) // max(least, 1)))
    start = total = 0
    for n, size in enumerate(sizes):
        if n > start and (total + size > most_bytes or n - start >= most_units):
            yield _Chunk(tuple(units[start:n]), _distinct(files[start:n]))
            start, total = n, 0
        total += size
    if start < len(units):
        yield _Chunk(tuple(units[start:]), _distinct(files[start:]))


def _distinct(files: Sequence[Sequence[Path]]) -> tuple[Path, ...]:
    return tuple({path: None for own in files for path in own})


def _appears(unit: Unit) -> bool:
    """Whether a result is in its folder, or appears there soon."""
    end = monotonic() + SHARED_FOLDER_S
    while not is_done(unit.path, unit.key):
        if monotonic() > end:
            return False
        with suppress(OSError):
            list(unit.path.parent.iterdir())  # makes a network folder look again
        sleep(0.2)
    return True


def _in_words(error: BaseException) -> BaseException:
    """An error of a worker, as a `WorkspaceError` if the worker lacks epipole."""
    if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == "epipole":
        return WorkspaceError(f"a worker has no epipole, or another version ({error})")
    return error
