"""SLAM compared with ORB-SLAM3 on the same frames. `python -m benchmarks.slam`.

Each program runs in its own process, in turn; results/slam_SET.json is written after every run.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine, run_measured
from benchmarks.peers.epipole_slam import EpipoleSlam
from benchmarks.peers.pyorbslam3_slam import Pyorbslam3Slam
from benchmarks.slam_score import score_run
from benchmarks.tasks.slam import TASKS, prepare, truths_of

LIMIT_S = 900.0
"""Time limit of a run."""
THREADS = 2
FIGURES = {
    "coverage": "frames %",
    "se3_m": "SE(3) cm",
    "sim3_m": "Sim(3) cm",
    "sim3_scale": "scale",
    "made_up_max": "false motion cm",
    "turn_max_deg": "rotation deg",
}

Run = dict[str, Any]


def main() -> None:
    """Run the chosen sequences and print a table for each."""
    arguments = _arguments()
    console = Console(width=max(170, Console().width))
    data = (
        arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    ).resolve()
    vocabulary = data / "slam" / "orb_vocabulary_10k.txt"
    peers: list[EpipoleSlam | Pyorbslam3Slam] = [EpipoleSlam()]
    peers += [Pyorbslam3Slam(arguments.orbslam_python, vocabulary, slower) for slower in arguments.slower]
    peers = [p for p in peers if not arguments.program or p.name.split()[0] in arguments.program]
    for peer in peers:
        if peer.version() is None:
            console.print(f"{peer.name} is skipped: it or its data are not installed", style="yellow")
    peers = [peer for peer in peers if peer.version() is not None]
    arguments.results.mkdir(parents=True, exist_ok=True)
    arguments.cache.mkdir(parents=True, exist_ok=True)
    for name in arguments.set:
        try:
            frames = prepare(name, data, arguments.cache.resolve())
        except FileNotFoundError as error:
            console.print(f"{name} is skipped: {error}", style="yellow")
            continue
        file = arguments.results / f"slam_{name}.json"
        report = _kept(file, name)
        for sensor in TASKS[name].sensors:
            if arguments.sensor and sensor not in arguments.sensor:
                continue
            _forget(report, sensor, [peer.name for peer in peers])
            for number in range(arguments.rounds):
                for peer in peers:
                    run = {"sensor": sensor, "program": peer.name, "version": peer.version(), "run": number}
                    run |= _one_run(peer, frames, sensor)
                    report["runs"].append(run)
                    console.print(
                        f"{name} {sensor} {number + 1}/{arguments.rounds} {peer.name}: {_line(run)}"
                    )
                    _write(file, report)
        console.print(_table(name, report))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="SLAM: epipole and ORB-SLAM3.")
    parser.add_argument("--set", nargs="+", choices=list(TASKS), default=list(TASKS), metavar="SET")
    parser.add_argument("--sensor", nargs="+", choices=["stereo", "rgbd", "mono"])
    parser.add_argument("--program", nargs="+", choices=["epipole", "pyorbslam3"])
    parser.add_argument(
        "--slower", nargs="+", type=float, default=[1.0], metavar="FACTOR",
        help="slow the frames for pyorbslam3 down by these factors",
    )  # fmt: skip
    parser.add_argument("--rounds", type=int, default=5, help="runs of each program")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    parser.add_argument(
        "--cache", type=Path, default=Path(tempfile.gettempdir()) / "epipole-slam-frames",
        help="folder for rendered and decoded frames (3 GB)",
    )  # fmt: skip
    parser.add_argument(
        "--orbslam-python", type=Path, default=Path(sys.executable), help="Python interpreter with pyorbslam3"
    )
    return parser.parse_args()


def _kept(file: Path, name: str) -> dict[str, Any]:
    """A new report with the runs of an earlier call."""
    runs = json.loads(file.read_text())["runs"] if file.is_file() else []
    return {"set": name, "machine": describe_machine(THREADS), "runs": runs, "summary": {}}


def _forget(report: dict[str, Any], sensor: str, programs: list[str]) -> None:
    """Remove the runs that are about to be repeated."""
    report["runs"] = [
        run for run in report["runs"] if run["sensor"] != sensor or run["program"] not in programs
    ]


def _one_run(peer: EpipoleSlam | Pyorbslam3Slam, frames: Path, sensor: str) -> Run:
    """Run a program once: time, memory and score; after a failure also the exit code and the end of the output."""
    with tempfile.TemporaryDirectory(prefix="epipole-bench-") as scratch:
        out, log = Path(scratch) / "out", Path(scratch) / "log"
        out.mkdir()
        measure = run_measured(peer.command(frames, sensor, out), log, THREADS, LIMIT_S)
        run: Run = {
            "exit_code": measure.exit_code,
            "wall_s": measure.wall_s,
            "peak_memory_mb": measure.peak_memory_mb,
        }
        if measure.exit_code != 0:
            run["error"] = log.read_text(errors="replace")[-2000:].replace(scratch, "WORK")
        if (out / "summary.json").is_file():
            run["summary"] = json.loads((out / "summary.json").read_text())
            run["score"] = score_run(out, frames, truths_of(frames))
    return run | {"commit": describe_machine(THREADS)["commit"]}


def _line(run: Run) -> str:
    score = run.get("score")
    if score is None:
        last = run["error"].strip().splitlines()[-1:] or [""]
        return f"failed (exit {run['exit_code']}): {last[0][:120]}"
    found = [f"{score['ms_median']:.0f} ms"]
    for when in ("causal", "final"):
        found.append(f"{when} {100 * score[when]['coverage']:.0f} %")
        truth = next((value for value in score[when].values() if isinstance(value, dict)), {})
        found += [f"{key} {value:.3g}" for key, value in truth.items() if key in FIGURES]
    return ", ".join(found) + ("" if run["exit_code"] == 0 else f" (exit {run['exit_code']})")


def _write(file: Path, report: dict[str, Any]) -> None:
    report["summary"] = _summary(report["runs"])
    text = json.dumps(report, indent=1).replace(str(REPOSITORY), "REPOSITORY").replace(str(Path.home()), "~")
    temporary = file.with_suffix(".part")
    temporary.write_text(text + "\n")
    temporary.replace(file)


def _summary(runs: list[Run]) -> dict[str, dict[str, dict[str, float]]]:
    """Median, minimum and maximum of every figure, by "SENSOR PROGRAM"."""
    grouped: dict[str, list[dict[str, float]]] = {}
    for run in runs:
        grouped.setdefault(f"{run['sensor']} {run['program']}", []).append(_flat(run.get("score", {})))
    out: dict[str, dict[str, dict[str, float]]] = {}
    for key, rows in grouped.items():
        out[key] = {}
        for figure in dict.fromkeys(name for row in rows for name in row):
            values = [row[figure] for row in rows if figure in row]
            median = statistics.median(values)
            out[key][figure] = {
                "median": median,
                "min": min(values),
                "max": max(values),
                "runs": len(values),
            }
    return out


def _flat(score: dict[str, Any], prefix: str = "") -> dict[str, float]:
    """Numbers of nested dictionaries, by their joined keys."""
    out: dict[str, float] = {}
    for key, value in score.items():
        if isinstance(value, dict):
            out |= _flat(value, f"{prefix}{key} ")
        elif isinstance(value, int | float):
            out[prefix + key] = float(value)
    return out


def _table(name: str, report: dict[str, Any]) -> Table:
    """One row per sensor, program and ground truth: medians of the poses on arrival (causal) and after the run (final)."""
    count = max((run["run"] for run in report["runs"]), default=-1) + 1
    table = Table(title=f"{name}: medians of up to {count} runs; causal / final", title_justify="left")
    for column in ("sensor", "program", "truth", *FIGURES.values(), "segments", "ms", "ms 95 %", "failed"):
        table.add_column(column, justify="right")
    for key, figures in report["summary"].items():
        sensor, program = key.split(" ", 1)
        runs = [run for run in report["runs"] if (run["sensor"], run["program"]) == (sensor, program)]
        failed = sum(run["exit_code"] != 0 for run in runs)
        names = {word.split()[1] for word in figures if word.startswith(("causal ", "final "))}
        for truth in sorted(names - {"coverage"}) or ["-"]:
            cells = [_both(figures, figure, truth) for figure in FIGURES]
            last = [_short(figures.get(figure)) for figure in ("segments", "ms_median", "ms_p95")]
            table.add_row(sensor, program, truth, *cells, *last, str(failed or ""))
    return table


def _both(figures: dict[str, dict[str, float]], figure: str, truth: str) -> str:
    factor = 100.0 if figure in ("coverage", "se3_m", "sim3_m", "made_up_max") else 1.0
    names = [
        f"{when} {figure}" if figure == "coverage" else f"{when} {truth} {figure}"
        for when in ("causal", "final")
    ]
    cells = [_short(figures.get(name), factor) for name in names]
    return " / ".join(cells) if any(cells) else ""


def _short(figure: dict[str, float] | None, factor: float = 1.0) -> str:
    return "" if figure is None else f"{factor * figure['median']:.3g}"


if __name__ == "__main__":
    main()
