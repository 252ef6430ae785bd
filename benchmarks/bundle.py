"""Bundle adjustment compared with Ceres (through pycolmap and pyceres) and GTSAM: `python -m benchmarks.bundle`.

Each program runs in its own process, in turn. The table has median times, and the time epipole takes to reach Ceres' final cost.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.peers.bundle import PEERS, BundleLimits, BundleRun, run_peer
from benchmarks.tasks.bundle import BundleTask, bal_task, city_task, ring_task
from benchmarks.tasks.sfm import data_root

_MAX_DENSE_FRAMES = 600
"""With more frames, pycolmap and Ceres' dense and iterative solvers take minutes and are skipped."""
_MAX_ITERATIVE_FRAMES = 200
"""From this number of frames on, Ceres' iterative solver takes minutes and is skipped."""


def tasks(data: Path) -> dict[str, Callable[[], BundleTask]]:
    """Functions that make the problems, by name."""
    bundle = data.resolve() / "bundle"
    return {
        "bal-16-22106": partial(bal_task, bundle / "problem-16-22106-pre.txt.bz2"),
        "bal-21-11315": partial(bal_task, bundle / "problem-21-11315-pre.txt.bz2"),
        "ring-50": partial(ring_task, 50, 5000),
        "ring-200": partial(ring_task, 200, 20_000),
        "ring-500": partial(ring_task, 500, 50_000),
        "city-200": partial(city_task, 200, 20_000, 100_000),
        "city-2000": partial(city_task, 2000, 100_000, 500_000),
    }


def seconds_to(run: BundleRun, cost: float) -> float | None:
    """Seconds until a run first reached a cost; None if it never did."""
    return next((seconds for seconds, at in run.costs_over_time or () if at <= cost), None)


def run_task(
    task: BundleTask, limits: BundleLimits, rounds: int, timeout_s: float, wanted: list[str] | None
) -> dict[str, Any]:
    """Run every program on one task: median seconds, and the costs and iterations of the first round."""
    frames = len(task.rotation)
    out: dict[str, Any] = {}
    runs: dict[str, list[BundleRun | str]] = {}
    for _ in range(rounds):
        for peer in PEERS:
            heavy = "DENSE" in peer.name or "ITERATIVE" in peer.name or peer.name == "pycolmap"
            if (wanted and peer.name not in wanted) or (heavy and frames > _MAX_DENSE_FRAMES):
                continue
            if "ITERATIVE" in peer.name and frames >= _MAX_ITERATIVE_FRAMES:
                continue
            runs.setdefault(peer.name, []).append(run_peer(peer, task, limits, timeout_s))
    for name, found in runs.items():
        successful = [run for run in found if not isinstance(run, str)]
        if not successful:
            out[name] = {"message": found[0]}
            continue
        out[name] = asdict(successful[0]) | {
            "seconds_solve": statistics.median(run.seconds_solve for run in successful)
        }
    ceres = [run for name, run in out.items() if name.startswith("py") and "final_cost" in run]
    if ceres and "epipole" in out:
        target = max(run["final_cost"] for run in ceres)
        reached = [seconds_to(run, target) for run in runs["epipole"] if not isinstance(run, str)]
        known = [seconds for seconds in reached if seconds is not None]
        out["epipole"]["seconds_to_ceres"] = statistics.median(known) if known else None
        out["epipole"]["share_of_ceres"] = (
            statistics.median(known) / min(run["seconds_solve"] for run in ceres) if known else None
        )
    return out


def print_table(report: dict[str, Any], names: list[str]) -> None:
    """Print one row for each program and task."""
    table = Table(title=f"bundle adjustment, {report['limits']['num_threads']} thread(s)")
    for column in (
        "task",
        "program",
        "solve s",
        "final cost",
        "steps",
        "us / (obs. x step)",
        "to Ceres' cost",
    ):
        table.add_column(column, justify="right")
    for name in names:
        for program, run in report[name]["programs"].items():
            if "final_cost" not in run:
                table.add_row(name, program, run["message"], "", "", "", "")
                continue
            each = 1e6 * run["seconds_solve"] / report[name]["observations"] / max(run["num_iterations"], 1)
            fraction = run.get("share_of_ceres")
            table.add_row(
                *(name, program, f"{run['seconds_solve']:.3f}", f"{run['final_cost']:.9g}"),
                *(str(run["num_iterations"]), f"{each:.2f}"),
                "" if fraction is None else f"{run['seconds_to_ceres']:.3f} s = {fraction:.2f} x",
            )
    Console(width=130).print(table)


def main() -> None:
    """Run the tasks and print the table."""
    parser = argparse.ArgumentParser(description="Bundle adjustment: epipole, Ceres and GTSAM.")
    names = list(tasks(Path()))
    parser.add_argument("--task", nargs="+", choices=names, default=names)
    parser.add_argument("--program", nargs="+", help="programs to run (default: all)")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--timeout", type=float, default=600.0, help="time limit of a program, seconds")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    limits = BundleLimits(num_threads=arguments.threads)
    report: dict[str, Any] = {"machine": describe_machine(arguments.threads), "limits": asdict(limits)}
    for name in arguments.task:
        task = tasks(data_root(arguments.data))[name]()
        found = run_task(task, limits, arguments.rounds, arguments.timeout, arguments.program)
        report[name] = {"observations": len(task.frame), "noise_floor": task.noise_floor, "programs": found}
    file = REPOSITORY / "benchmarks" / "results" / f"bundle_{arguments.threads}_threads.json"
    file.write_text(json.dumps(report, indent=1) + "\n")
    print_table(report, arguments.task)


if __name__ == "__main__":
    main()
