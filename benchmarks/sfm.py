"""Structure from motion compared with COLMAP on the same images: `python -m benchmarks.sfm --set fountain-P11 lund_gps`.

Each program runs in its own process, in turn. Runs and medians go to benchmarks/results/sfm_SET.json. Downloaded scenes of ETH3D, the
Image Matching Challenge and 1DSfM: `python -m benchmarks.sfm --scenes FOLDER`.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine, run_measured
from benchmarks.peers.base import Limits, SfmPeer
from benchmarks.peers.epipole_sfm import EpipoleSfm
from benchmarks.peers.pycolmap_sfm import PycolmapSfm
from benchmarks.score import score_models
from benchmarks.tasks.public_sets import tasks_in
from benchmarks.tasks.sfm import SETS, SfmTask, data_root, prepare

NUM_WARM_UP_IMAGES = 4
BEST = "pycolmap-best"
"""Name of the better one of pycolmap's mappers in each run."""
ROWS = {
    "registered": "images registered",
    "position_mean": "position mean",
    "position_median": "position median",
    "position_max": "position max",
    "rotation_mean_deg": "rotation mean (deg)",
    "auc_0.5": "AUC @ 0.5 deg",
    "auc_1": "AUC @ 1 deg",
    "auc_3": "AUC @ 3 deg",
    "auc_5": "AUC @ 5 deg",
    "auc_10": "AUC @ 10 deg",
    "gps_median_m": "distance to GPS, median (m)",
    "axis_to_motion_median_deg": "axis to motion (deg)",
    "points": "points",
    "observations": "observations",
    "unreadable_models": "invalid models",
    "wall_s": "total time (s)",
    "peak_memory_mb": "peak memory (MB)",
}

Run = dict[str, Any]


def main() -> None:
    """Run the chosen sets and print a table for each."""
    arguments = _arguments()
    console = Console(width=max(110, Console().width))
    limits = Limits(arguments.max_image_size, arguments.max_features, arguments.threads)
    peers: list[SfmPeer] = [
        EpipoleSfm(),
        PycolmapSfm("incremental", shared_camera=arguments.shared_camera),
        PycolmapSfm("global", "pycolmap-incremental", shared_camera=arguments.shared_camera),
    ]
    installed = [peer for peer in peers if peer.version() is not None]
    with tempfile.TemporaryDirectory(prefix="epipole-bench-") as scratch:
        work = Path(scratch)
        try:
            for task in _tasks(arguments, work / "data"):
                if not arguments.cold:
                    _warm_up(task, installed, limits, work / "warm-up" / task.name)
                runs = _interleaved(task, installed, limits, work / task.name, arguments.runs, console)
                report = _report(task, runs, peers, limits, arguments)
                arguments.results.mkdir(parents=True, exist_ok=True)
                file = arguments.results / f"sfm_{task.name}.json"
                file.write_text(_without_paths(json.dumps(report, indent=1), task, work) + "\n")
                console.print(_table(task, report, peers))
                console.print(f"written to {file}\n")
        except FileNotFoundError as error:
            console.print(str(error), style="red")
            sys.exit(1)


def _tasks(arguments: argparse.Namespace, work: Path) -> Iterator[SfmTask]:
    """The chosen sets, or all scenes in the given folder."""
    if arguments.scenes is not None:
        yield from tasks_in(arguments.scenes, work)
        return
    for name in arguments.set:
        yield prepare(name, data_root(arguments.data).resolve(), work)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Structure from motion: epipole and pycolmap.")
    default = Limits()
    parser.add_argument("--set", nargs="+", choices=list(SETS), default=list(SETS), metavar="SET")
    parser.add_argument("--scenes", type=Path, help="folder of downloaded scenes, instead of the sets")
    parser.add_argument("--runs", type=int, default=3, help="runs of each program")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    parser.add_argument("--max-image-size", type=int, default=default.max_image_size)
    parser.add_argument("--max-features", type=int, default=default.max_num_features)
    parser.add_argument("--threads", type=int, default=default.num_threads)
    parser.add_argument(
        "--cold", action="store_true", help="skip the warm-up; the first run compiles kernels"
    )
    parser.add_argument(
        "--shared-camera", action="store_true", help="make pycolmap use one camera for all images"
    )
    return parser.parse_args()


def _warm_up(task: SfmTask, peers: list[SfmPeer], limits: Limits, work: Path) -> None:
    """Run each program on a few images, so that libraries are loaded and kernels are compiled.

    The run may fail, because a few images do not always give a model. Programs that start from another one's files are skipped.
    """
    images = work / "images"
    names = task.image_names[:NUM_WARM_UP_IMAGES]
    for name in names:
        (images / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(task.images / name, images / name)
    for peer in peers:
        if peer.needs is None:
            out = work / peer.name
            command = peer.command(replace(task, images=images, image_names=names), out, limits)
            run_measured(command, out.with_suffix(".log"), limits.num_threads)


def _interleaved(
    task: SfmTask, peers: list[SfmPeer], limits: Limits, work: Path, num_runs: int, console: Console
) -> list[Run]:
    """Run the programs in turn (A B C A B C), so that load on the machine affects all of them."""
    runs = []
    for number in range(num_runs):
        folder = work / f"run{number}"
        for peer in peers:
            run = {"run": number, "peer": peer.name} | _one_run(task, peer, limits, folder)
            console.print(f"{task.name} run {number + 1}/{num_runs} {peer.name}: {_summary_line(run)}")
            runs.append(run)
        shutil.rmtree(folder, ignore_errors=True)
    return runs


def _one_run(task: SfmTask, peer: SfmPeer, limits: Limits, folder: Path) -> Run:
    """Run a program once: time, memory and score; after a failure also the exit code and the end of the output."""
    out, log = folder / peer.name, folder / f"{peer.name}.log"
    if peer.needs is not None and not (folder / peer.needs / "summary.json").is_file():
        return {"exit_code": None, "error": f"{peer.needs} wrote no summary to start from"}
    measure = run_measured(peer.command(task, out, limits), log, limits.num_threads)
    run: Run = asdict(measure)
    summary = out / "summary.json"
    if summary.is_file():
        run["summary"] = json.loads(summary.read_text())
    if peer.needs is not None:
        stages = json.loads((folder / peer.needs / "summary.json").read_text())["seconds"]
        run["own_wall_s"], run["wall_s"] = (
            run["wall_s"],
            run["wall_s"] + stages["features"] + stages["matches"],
        )
    if measure.exit_code != 0:
        run["error"] = log.read_text(errors="replace")[-2000:]
    return run | {"score": score_models(task, out / "sparse")}


def _summary_line(run: Run) -> str:
    if run["exit_code"] != 0:
        return f"failed (exit {run['exit_code']}): {run['error'].strip().splitlines()[-1:]}"
    score = run["score"]
    return f"{score['registered']} of {score['pictures']} registered, {run['wall_s']:.1f} s"


def value_of(run: Run, metric: str) -> float | None:
    """A figure of a run (time, memory or part of the score); None if the run does not have it."""
    if metric in ("wall_s", "peak_memory_mb"):
        return run.get(metric) if run["exit_code"] == 0 else None
    return run.get("score", {}).get(metric)


def best_mapper(candidates: list[Run]) -> Run | None:
    """The best of several runs: more registered images, then a smaller position error, then more observations."""

    def rank(run: Run) -> tuple[float, float, float]:
        error = value_of(run, "position_mean")
        accuracy = -error if error is not None else -math.inf
        return value_of(run, "registered") or 0, accuracy, value_of(run, "observations") or 0

    successful = [run for run in candidates if run["exit_code"] == 0]
    return max(successful, key=rank, default=None)


def summarize(runs: list[Run]) -> dict[str, dict[str, float]]:
    """Median, minimum and maximum of every figure over the runs of one program."""
    out = {}
    for metric in ROWS:
        values = sorted(v for run in runs if (v := value_of(run, metric)) is not None)
        if values:
            out[metric] = {"median": _median(values), "min": values[0], "max": values[-1]}
    return out


def paired_ratios(ours: list[Run], theirs: list[Run]) -> dict[str, dict[str, float]]:
    """Ratios of our figures to theirs in runs with the same number: median, minimum and maximum."""
    partner, out = {run["run"]: run for run in theirs}, {}
    for metric in ROWS:
        ratios = []
        for run in ours:
            a, b = value_of(run, metric), value_of(partner.get(run["run"], {"exit_code": None}), metric)
            if a is not None and b:
                ratios.append(a / b)
        if ratios:
            out[metric] = {"median": _median(sorted(ratios)), "min": min(ratios), "max": max(ratios)}
    return out


def _median(values: list[float]) -> float:
    half = len(values) // 2
    return values[half] if len(values) % 2 else (values[half - 1] + values[half]) / 2


def _report(
    task: SfmTask, runs: list[Run], peers: list[SfmPeer], limits: Limits, arguments: argparse.Namespace
) -> dict[str, Any]:
    by_peer = {peer.name: [run for run in runs if run["peer"] == peer.name] for peer in peers}
    mappers = [run for run in runs if run["peer"].startswith("pycolmap")]
    best = [best_mapper([run for run in mappers if run["run"] == n]) for n in range(arguments.runs)]
    by_peer[BEST] = [run for run in best if run is not None]
    return {
        "set": task.name,
        "pictures": len(task.image_names),
        "told": task.known,
        "unit": task.unit,
        "limits": asdict(limits),
        "warm_up": "none" if arguments.cold else f"one run on {NUM_WARM_UP_IMAGES} images, not counted",
        "pycolmap_shared_camera": arguments.shared_camera,
        "machine": describe_machine(limits.num_threads),
        "versions": {peer.name: peer.version() for peer in peers},
        "summary": {name: summarize(of_peer) for name, of_peer in by_peer.items() if of_peer},
        "epipole_over": {
            name: paired_ratios(by_peer["epipole"], of_peer)
            for name, of_peer in by_peer.items()
            if of_peer and name != "epipole"
        },
        "best_mappers": [run["peer"] for run in by_peer[BEST]],
        "runs": runs,
    }


def _without_paths(text: str, task: SfmTask, work: Path) -> str:
    """Replace paths of this machine by placeholders."""
    for folder, name in (
        (task.images, "IMAGES"),
        (work, "WORK"),
        (REPOSITORY, "REPOSITORY"),
        (Path.home(), "~"),
    ):
        text = text.replace(str(folder), name)
    return text


def _table(task: SfmTask, report: dict[str, Any], peers: list[SfmPeer]) -> Table:
    """One row per figure, one column per program, and the ratio of epipole to pycolmap's better mapper."""
    num_runs = max((run["run"] for run in report["runs"]), default=-1) + 1
    title = (
        f"{task.name}: {len(task.image_names)} images, given: {task.known}; median (range) of {num_runs} runs"
    )
    table = Table(title=title, title_justify="left")
    table.add_column("", no_wrap=True)
    for peer in peers:
        table.add_column(f"{peer.name} {peer.version() or ''}", justify="right")
    table.add_column("epipole / best", justify="right")
    ratios = report["epipole_over"].get(BEST, {})
    for metric, label in ROWS.items():
        unit = f" ({task.unit})" if metric.startswith("position") and task.unit else ""
        cells = [_cell(report["summary"].get(peer.name, {}).get(metric)) for peer in peers]
        if any(cells):
            table.add_row(label + unit, *cells, _cell(ratios.get(metric)))
    missing = ["" if peer.version() else "not installed" for peer in peers]
    if any(missing):
        table.add_row("", *missing, "")
    failed = [sum(r["peer"] == p.name and r["exit_code"] != 0 for r in report["runs"]) for p in peers]
    if any(failed):
        table.add_row("failed runs", *map(str, failed), "")
    return table


def _cell(figure: dict[str, float] | None) -> str:
    if figure is None:
        return ""
    median, low, high = (_short(figure[key]) for key in ("median", "min", "max"))
    return median if low == high else f"{median} ({low}-{high})"


def _short(value: float) -> str:
    if float(value).is_integer() or abs(value) >= 1000:
        return f"{value:.0f}"
    return f"{value:.3g}"


if __name__ == "__main__":
    main()
