"""Time and memory of bundle adjustment against the number of cameras in a city. `python -m benchmarks.growth`.

Each size runs in its own process. Time is that of the adjustment; memory is the peak resident size, including the problem.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.peers.bundle import BundleLimits, Epipole
from benchmarks.tasks.bundle import city_task

SIZES = (250, 500, 1000, 2000, 4000, 10_000)
POINTS_PER_FRAME, OBSERVATIONS_PER_POINT = 500, 5
_UNIT = 1 if sys.platform == "darwin" else 1024
"""Bytes per unit of `ru_maxrss`."""


def adjust_city(num_frames: int, *, single_precision: bool) -> dict[str, Any]:
    """Adjust one city: time, memory, and the ratio of the final cost to that expected from the noise."""
    num_points = POINTS_PER_FRAME * num_frames
    task = city_task(num_frames, num_points, OBSERVATIONS_PER_POINT * num_points)
    peer, limits = Epipole(), BundleLimits()
    peer.adjust(
        city_task(20, 2000, 10_000), replace(limits, max_iterations=1), single_precision=single_precision
    )
    found = peer.adjust(task, limits, single_precision=single_precision)
    floor = task.noise_floor
    return {
        "frames": num_frames,
        "points": num_points,
        "observations": len(task.frame),
        "seconds": found.seconds_solve,
        "iterations": found.num_iterations,
        "cost": found.own_cost,
        "cost_over_floor": None if floor is None else found.own_cost / floor,
        "message": found.message,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _UNIT / 1e9,
    }


def _serve(num_frames: int, single_precision: bool, connection: Any) -> None:
    connection.send(adjust_city(num_frames, single_precision=single_precision))


def main() -> None:
    """Run the sizes, print the table and write the results."""
    parser = argparse.ArgumentParser(description="Bundle adjustment of cities of different sizes.")
    parser.add_argument("--frames", type=int, nargs="+", default=SIZES)
    parser.add_argument("--single", action="store_true", help="eliminate points in single precision")
    arguments = parser.parse_args()
    context = get_context("spawn")
    rows = []
    table = Table(title="a city, 500 points per frame, 5 observations per point")
    for column in (
        "frames",
        "observations",
        "seconds",
        "steps",
        "us / (obs. x step)",
        "peak GB",
        "cost / floor",
    ):
        table.add_column(column, justify="right")
    for num_frames in arguments.frames:
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_serve, args=(num_frames, arguments.single, theirs))
        process.start()
        theirs.close()
        try:
            row = ours.recv()
        except EOFError:
            process.join()
            table.add_row(str(num_frames), "", f"ended with exit code {process.exitcode}", "", "", "", "")
            continue
        process.join()
        rows.append(row)
        each = 1e6 * row["seconds"] / row["observations"] / row["iterations"]
        table.add_row(
            *(str(num_frames), f"{row['observations']:,}", f"{row['seconds']:.2f}", str(row["iterations"])),
            *(f"{each:.2f}", f"{row['peak_gb']:.2f}", f"{row['cost_over_floor']:.5f}"),
        )
    name = "growth_single.json" if arguments.single else "growth.json"
    file = REPOSITORY / "benchmarks" / "results" / name
    file.write_text(json.dumps({"machine": describe_machine(0), "cities": rows}, indent=1) + "\n")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
