"""Robust estimators compared on the same problems with the same limits and one thread each.

`python -m benchmarks.estimation --task relative-500-70` prints times, errors, and ratios with bootstrap intervals.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.peers.estimation import PEERS, Model, Worker
from benchmarks.tasks.estimation import TASKS, EstimationProblem, EstimationTask
from benchmarks.tasks.sfm import data_root
from epipole.geometry import sampson_error
from epipole.metrics import area_under_recall

OURS = "epipole"
WARM_UP = 3
"""Problems solved before the measurement."""
RESAMPLES = 2000
"""Number of bootstrap resamples."""
FAILED = 1e6
"""Error of a problem without a solution."""
AUC_DEG = (5.0, 10.0, 20.0)
WITH_CAMERA_MODELS = ("epipole", "poselib", "pycolmap")
"""Packages that support cameras other than pinholes."""


def main() -> None:
    """Run the chosen tasks and print a table for each."""
    arguments = _arguments()
    console = Console(width=max(120, Console().width))
    for name in arguments.task:
        task = TASKS[name]
        seconds, errors = _measure(task, arguments, console)
        report = {"task": name, "limits": limits_of(task), "machine": describe_machine(1)} | summarize(
            task, seconds, errors
        )
        arguments.results.mkdir(parents=True, exist_ok=True)
        file = arguments.results / f"estimation_{name}.json"
        file.write_text(json.dumps(report, indent=1) + "\n")
        console.print(_table(task, report))


def limits_of(task: EstimationTask) -> dict[str, Any]:
    """The limits of a task as a dictionary."""
    limits = task.limits
    return {name: getattr(limits, name) for name in limits.__slots__}


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Robust estimators: epipole and other programs.")
    parser.add_argument("--task", nargs="+", choices=list(TASKS), default=list(TASKS), metavar="TASK")
    parser.add_argument("--count", type=int, default=200, help="minimum number of problems per task")
    parser.add_argument("--peer", nargs="+", default=[peer.name for peer in PEERS])
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    return parser.parse_args()


def _measure(
    task: EstimationTask, arguments: argparse.Namespace, console: Console
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    problems = task.problems(data_root(arguments.data).resolve(), arguments.count)
    workers = []
    for peer in PEERS:
        if peer.name not in arguments.peer:
            continue
        if peer.version() is None:
            console.print(f"{peer.name}: not installed")
        elif problems[0].camera != "PINHOLE" and peer.package not in WITH_CAMERA_MODELS:
            console.print(f"{peer.name}: does not support {problems[0].camera}")
        elif peer.package != "pydegensac" or task.kind in ("fundamental", "homography"):
            workers.append(Worker(peer, task.kind))
    if not workers:
        sys.exit("No program to run: the chosen ones are not installed or do not support the task.")
    for worker in workers:
        for problem in problems[:WARM_UP]:
            worker.solve(problem, task.limits)
    seconds: dict[str, list[float]] = {w.name: [] for w in workers}
    errors: dict[str, list[float]] = {w.name: [] for w in workers}
    for problem in problems:
        for worker in workers:
            median_s, model = worker.solve(problem, task.limits)
            seconds[worker.name].append(median_s)
            errors[worker.name].append(error_of(problem, model))
    for worker in workers:
        worker.close()
    return {k: np.array(v) for k, v in seconds.items()}, {k: np.array(v) for k, v in errors.items()}


def error_of(problem: EstimationProblem, model: Model) -> float:
    """Degrees for poses; median Sampson (F) or transfer (H) error of the true matches in pixels."""
    if model is None:
        return FAILED
    if problem.motion is not None:
        R, t = model
        return _motion_error(problem, np.asarray(R), np.asarray(t).ravel())
    matrix = np.asarray(model)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or problem.validation is None:
        return FAILED
    a, b = problem.validation[:, :2], problem.validation[:, 2:]
    if problem.kind == "fundamental":
        return float(np.median(sampson_error(matrix, a, b)))
    moved = np.c_[a, np.ones(len(a))] @ matrix.T
    return float(np.median(np.linalg.norm(moved[:, :2] / moved[:, 2:] - b, axis=1)))


def _motion_error(problem: EstimationProblem, R: np.ndarray, t: np.ndarray) -> float:
    """The larger of rotation and direction error in degrees; for absolute poses the rotation error."""
    true = problem.motion
    assert true is not None
    cosine = np.clip(0.5 * (np.trace(R @ true.rotation.T) - 1.0), -1.0, 1.0)
    sine = 0.5 * np.linalg.norm(R @ true.rotation.T - true.rotation @ R.T) / np.sqrt(2.0)
    rotation = float(np.degrees(np.arctan2(sine, cosine)))
    if problem.kind == "absolute_pose":
        return rotation
    norm = np.linalg.norm(t) * np.linalg.norm(true.translation)
    if not norm > 0:
        return FAILED
    crossed = np.linalg.norm(np.cross(t, true.translation))
    return max(rotation, float(np.degrees(np.arctan2(crossed, t @ true.translation))))


def summarize(
    task: EstimationTask, seconds: dict[str, np.ndarray], errors: dict[str, np.ndarray]
) -> dict[str, Any]:
    """Figures of every program, and the ratios of epipole's figures to its own with 95 % bootstrap intervals."""
    rows = {}
    for name, e in errors.items():
        ms = 1e3 * seconds[name]
        rows[name] = {
            "median_ms": float(np.median(ms)),
            "p90_ms": float(np.percentile(ms, 90)),
            "median_error": float(np.median(e)),
            "p90_error": float(np.percentile(e, 90)),
            "failed": int((e >= FAILED).sum()),
        }
        if task.kind == "relative_pose":
            rows[name]["auc"] = [100.0 * float(a) for a in area_under_recall(e, AUC_DEG)]
        if OURS in errors and name != OURS:
            rows[name]["ours_over_it"] = ratios(seconds[OURS], seconds[name], errors[OURS], e)
    return {"problems": len(next(iter(errors.values()))), "programs": rows}


def ratios(
    our_s: np.ndarray, their_s: np.ndarray, ours: np.ndarray, theirs: np.ndarray
) -> dict[str, list[float]]:
    """[ratio, lower bound, upper bound] (95 %) of median time, median error and 90 % error, resampling problems."""
    rng = np.random.default_rng(0)
    chosen = rng.integers(len(ours), size=(RESAMPLES, len(ours)))
    out = {}
    for name, a, b, q in (
        ("median_time", our_s, their_s, 50),
        ("median_error", ours, theirs, 50),
        ("p90_error", ours, theirs, 90),
    ):
        spread = np.percentile(a[chosen], q, axis=1) / np.percentile(b[chosen], q, axis=1)
        low, high = np.percentile(spread, [2.5, 97.5])
        out[name] = [float(np.percentile(a, q) / np.percentile(b, q)), float(low), float(high)]
    return out


def _table(task: EstimationTask, report: dict[str, Any]) -> Table:
    unit = "px" if task.kind in ("fundamental", "homography") else "deg"
    table = Table(title=f"{task.name}, {report['problems']} problems")
    for column in ("program", "ms", "p90 ms", f"median {unit}", f"p90 {unit}", "failed", "AUC@5/10/20"):
        table.add_column(column, justify="right")
    for column in ("time ratio", "median ratio", "p90 ratio"):
        table.add_column(column, justify="right")
    for name, row in report["programs"].items():
        auc = "/".join(f"{a:.1f}" for a in row.get("auc", []))
        figures = [f"{row[k]:.3g}" for k in ("median_ms", "p90_ms", "median_error", "p90_error")]
        ratio = row.get("ours_over_it", {})
        spans = [f"{r[0]:.2f} [{r[1]:.2f}, {r[2]:.2f}]" for r in ratio.values()] or [""] * 3
        table.add_row(name, *figures, str(row["failed"]), auc, *spans)
    return table


if __name__ == "__main__":
    main()
