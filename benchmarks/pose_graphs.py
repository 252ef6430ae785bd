"""Pose graph optimization compared with GTSAM, each in its own process: `python -m benchmarks.pose_graphs`.

Time is that of the optimization. Costs are half the sum of r^T Omega r; GTSAM fixes the first pose by a prior.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.tasks.sfm import data_root

GRAPHS = (
    {
        name: f"{name}.g2o"
        for name in ("sphere2500", "torus3D", "parking-garage", "sphere_noisy_init", "intel")
    }
    | {
        f"manhattan-{start}": f"manhattan/originalDataset/{start}/manhattanOlson3500.g2o"
        for start in ("Olson", "g2o")
    }
    | {"ringCity": "ringCity/originalDataset/ringCity.g2o"}
)


def with_epipole(path: str) -> tuple[float, float, int]:
    """(seconds, cost, iterations) from the initial values in the file."""
    from epipole.io import read_g2o
    from epipole.optim import PoseGraphConfig, optimize_pose_graph

    graph = read_g2o(path).graph
    optimize_pose_graph(graph, PoseGraphConfig(max_iterations=1))
    start = time.perf_counter()
    found = optimize_pose_graph(graph)
    return time.perf_counter() - start, found.final_cost, found.num_iterations


def with_epipole_chordal(path: str) -> tuple[float, float, int]:
    """(seconds, cost, iterations) from the edges only, including the initialization."""
    from epipole.io import read_g2o
    from epipole.optim import PoseGraphConfig, initialize_pose_graph, optimize_pose_graph

    graph = read_g2o(path).graph
    optimize_pose_graph(graph, PoseGraphConfig(max_iterations=1))
    start = time.perf_counter()
    found = optimize_pose_graph(initialize_pose_graph(graph))
    return time.perf_counter() - start, found.final_cost, found.num_iterations


def with_gtsam(path: str) -> tuple[float, float, int]:
    """(seconds, cost, iterations) of GTSAM's Levenberg-Marquardt with default options."""
    import gtsam
    import numpy as np

    is_planar = "SE2" in Path(path).read_text(encoding="utf-8")[:40]
    graph, initial = gtsam.readG2o(path, not is_planar)
    first = min(initial.keys())
    noise = gtsam.noiseModel.Diagonal.Variances(np.full(3 if is_planar else 6, 1e-6))
    if is_planar:
        graph.add(gtsam.PriorFactorPose2(first, initial.atPose2(first), noise))
    else:
        graph.add(gtsam.PriorFactorPose3(first, initial.atPose3(first), noise))
    start = time.perf_counter()
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial, gtsam.LevenbergMarquardtParams())
    found = optimizer.optimize()
    return time.perf_counter() - start, graph.error(found), optimizer.iterations()


PROGRAMS = {"epipole": with_epipole, "epipole, chordal start": with_epipole_chordal, "GTSAM LM": with_gtsam}


def _serve(run: Any, path: str, connection: Any) -> None:
    try:
        connection.send(run(path))
    except (ImportError, RuntimeError) as error:
        connection.send(repr(error))


def in_own_process(run: Any, path: str) -> Any:
    """Run a program on a file in a new process: its result, or the message of its exception."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(run, path, theirs))
    process.start()
    out = ours.recv()
    process.join()
    return out


def main() -> None:
    """Run every graph, print the table and write the results."""
    parser = argparse.ArgumentParser(description="Pose graphs: epipole and GTSAM.")
    parser.add_argument("--graph", nargs="+", choices=list(GRAPHS), default=list(GRAPHS))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    folder = data_root(arguments.data).resolve() / "posegraph"
    report: dict[str, Any] = {"machine": describe_machine(1)}
    table = Table(title="pose graphs")
    for column in ("graph", "program", "seconds", "cost", "iterations"):
        table.add_column(column, justify="right")
    for name in arguments.graph:
        runs: dict[str, list[Any]] = {program: [] for program in PROGRAMS}
        for _ in range(arguments.rounds):
            for program, run in PROGRAMS.items():
                runs[program].append(in_own_process(run, str(folder / GRAPHS[name])))
        for program, found in runs.items():
            if isinstance(found[0], str):
                table.add_row(name, program, found[0], "", "")
                continue
            seconds = statistics.median(f[0] for f in found)
            report.setdefault(name, {})[program] = {
                "seconds": seconds,
                "cost": found[0][1],
                "iterations": found[0][2],
            }
            table.add_row(name, program, f"{seconds:.3f}", f"{found[0][1]:.9g}", str(found[0][2]))
    file = REPOSITORY / "benchmarks" / "results" / "pose_graphs.json"
    file.write_text(json.dumps(report, indent=1) + "\n")
    Console().print(table)


if __name__ == "__main__":
    main()
