"""The same reconstruction with threads and on a Dask cluster of two processes: `python -m benchmarks.cluster --set fountain-P11`.

Runs alternate. Without a shared folder, the bytes of files that went to and from the workers are counted. With --losses N, a worker is
killed at a random time in N more runs, and frozen for FROZEN_S in another. All results are compared byte by byte with those of threads.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import statistics
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import distributed
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.tasks.rendered_sets import prepare_set
from benchmarks.tasks.sfm import SETS, data_root, prepare
from epipole import reconstruct
from epipole.cameras import Camera
from epipole.runs import joined
from epipole.runs.cluster import Connection
from epipole.synthetic import courtyard, courtyard_views, render

TIMED = {"summary.json", "report.html", "epipole.json", "config.json", "log.txt"}
"""Files that contain times."""
FROZEN_S = 30.0
COURTYARD, STREET = "courtyard", "street"
"""Names of the rendered sets."""
COURTYARD_IMAGES = 36
STREET_IMAGES = 200


def images_of(name: str, data: Path, folder: Path) -> Path:
    """Folder with the images of a set; rendered ones are written below `folder`."""
    if name == STREET:
        return prepare_set(STREET, STREET_IMAGES, folder).images
    if name != COURTYARD:
        return prepare(name, data, folder).images
    camera, out = Camera("PINHOLE", 640, 480, [520.0, 520.0, 319.5, 239.5]), folder / COURTYARD
    out.mkdir(parents=True, exist_ok=True)
    for k, cam_from_world in enumerate(courtyard_views(COURTYARD_IMAGES)):
        cv2.imwrite(str(out / f"{k:03d}.png"), render(courtyard(), camera, cam_from_world).rgb[..., ::-1])
    return out


def main() -> None:
    """Run, print the table and write the results."""
    parser = argparse.ArgumentParser(description="Threads and a cluster of two processes.")
    parser.add_argument("--set", default="fountain-P11", choices=[*SETS, COURTYARD, STREET], metavar="SET")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--losses", type=int, default=0, help="runs in which a worker is killed")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        images = images_of(arguments.set, data_root(arguments.data), Path(folder))
        found = measure(images, Path(folder), arguments.runs, arguments.losses)
    found = {"set": arguments.set, "machine": describe_machine(2), **found}
    file = REPOSITORY / "benchmarks" / "results" / f"cluster_{arguments.set}.json"
    file.write_text(json.dumps(found, indent=1) + "\n")
    table = Table(title=arguments.set)
    for column in ("where", "seconds, median", "relative", "same files", "MB to / from workers per image"):
        table.add_column(column)
    for row in found["rows"]:
        moved = f"{row['sent_mb']:.2f} / {row['received_mb']:.2f}" if row["sent_mb"] else ""
        seconds, relative = (f"{row[name]:.2f}" for name in ("seconds", "relative"))
        table.add_row(row["where"], seconds, relative, f"{row['num_same']} of {row['num_runs']}", moved)
    Console(width=110).print(table)


def measure(images: Path, folder: Path, num_runs: int, num_losses: int) -> dict[str, Any]:
    """Rows of the table."""
    reference = folder / "reference"
    num_images = reconstruct(images, reference).summary["num_images"]
    rows: dict[str, list[dict[str, Any]]] = {}
    with _cluster() as client:
        reconstruct(images, folder / "warm-up", executor=client)
        for n in range(num_runs):
            for where in ("threads", "shared folder", "no shared folder"):
                rows.setdefault(where, []).append(
                    _run(images, folder / f"{where} {n}", reference, client, where)
                )
    usual_s = statistics.median(run["seconds"] for run in rows["shared folder"])
    for n in range(num_losses):
        where = ("shared folder", "no shared folder")[n % 2]
        with (
            _cluster() as client
        ):  # Dask does not always start a worker again that was killed while it started
            _later(random.Random(n).uniform(0.0, 0.7 * usual_s), client, signal.SIGKILL)
            rows.setdefault("a worker killed", []).append(
                _run(images, folder / f"killed {n}", reference, client, where)
            )
    if num_losses:
        with _cluster() as client:
            process = _later(0.2 * usual_s, client, signal.SIGSTOP)
            thaw = threading.Timer(FROZEN_S, _send, (process, signal.SIGCONT))
            thaw.start()
            rows["a worker frozen"] = [_run(images, folder / "frozen", reference, client, "shared folder")]
            thaw.cancel()
            _send(process, signal.SIGCONT)
    first = statistics.median(run["seconds"] for run in rows["threads"])
    return {"rows": [_summary(where, runs, first, num_images) for where, runs in rows.items()]}


@contextmanager
def _cluster() -> Iterator[Any]:
    with (
        distributed.LocalCluster(
            2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as local,
        distributed.Client(local, set_as_default=False) as client,
    ):
        yield client


def _later(seconds: float, client: Any, number: signal.Signals) -> int:
    """Send a signal to a worker after some time; returns its process number."""
    process = next(iter(client.run(os.getpid).values()))
    threading.Timer(seconds, _send, (process, number)).start()
    return process


def _send(process: int, number: signal.Signals) -> None:
    with suppress(ProcessLookupError):  # it has ended
        os.kill(process, number)


def _run(images: Path, out: Path, reference: Path, client: Any, where: str) -> dict[str, Any]:
    connection = joined(client, has_shared_folder=where != "no shared folder")
    executor: Connection | str = "threads" if where == "threads" else connection
    start = perf_counter()
    reconstruct(images, out, executor=executor)
    seconds = perf_counter() - start
    moved = {"sent": connection.bytes_sent, "received": connection.bytes_received}
    return {"seconds": seconds, "is_same": _is_same(reference, out), **moved}


def _is_same(first: Path, second: Path) -> bool:
    """Whether all files are equal, except those that contain times; both folders have the same ones."""
    names = [
        {p.relative_to(root) for p in root.rglob("*") if p.is_file() and p.name[0] != "."}
        for root in (first, second)
    ]
    wanted = [{name for name in each if name.name not in TIMED} for each in names]
    return wanted[0] == wanted[1] and all(
        (first / name).read_bytes() == (second / name).read_bytes() for name in wanted[0]
    )


def _summary(where: str, runs: list[dict[str, Any]], first_s: float, num_images: int) -> dict[str, Any]:
    seconds = statistics.median(run["seconds"] for run in runs)
    moved = {
        f"{way}_mb": statistics.median(run[way] for run in runs) / num_images / 1e6
        for way in ("sent", "received")
    }
    return {
        "where": where,
        "seconds": seconds,
        "relative": seconds / first_s,
        "num_same": sum(run["is_same"] for run in runs),
        "num_runs": len(runs),
        **moved,
    }


if __name__ == "__main__":
    main()
