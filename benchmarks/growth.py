"""How time and memory of bundle adjustment grow: cities of more and more cameras. `python -m benchmarks.growth`.

Each size runs in a process of its own. Seconds are those of the adjustment alone, its layout included; memory is the greatest
resident size of the process, the problem itself included.
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


def adjust_city(num_frames: int, *, single_precision: bool) -> dict[str, Any]:
    """One city: what it took, and how far the cost is from what the noise alone would leave."""
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
    """Run the sizes and print the table."""
    parser = argparse.ArgumentParser(description="Growth of bundle adjustment with the size of a city.")
    parser.add_argument("--frames", type=int, nargs="+", default=SIZES)
    parser.add_argument("--single", action="store_true", help="eliminated points in single precision")
    arguments = parser.parse_args()
    context = get_context("spawn")
    rows = []
    table = Table(title="a city, 500 points a frame, 5 observations a point")
    for column in (
        "frames",
        "observations",
        "seconds",
        "steps",
        "us / obs. and step",
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
