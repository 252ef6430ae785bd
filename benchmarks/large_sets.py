"""Large sets of rendered images with exact poses, through `epipole reconstruct`: `python -m benchmarks.large_sets`.

Renders the sets of `benchmarks.tasks.rendered_sets`, reconstructs each in its own process on two threads, and compares the largest model
with the true poses. Memory is that of the process and of those that it starts. `--set`, `--images` and `--out` choose what is run and where
images and models are kept. Processor seconds of everything else show whether the machine was shared, which makes the times too long.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing, suppress
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.score import cams_in_order, largest_model
from benchmarks.tasks.rendered_sets import SETS, RenderedSet, enu_about, prepare_set
from epipole.geometry import Rigid3
from epipole.io.images.photographs import read_header
from epipole.metrics import camera_errors

NUM_THREADS = 2
SAMPLE_EVERY_S, SAMPLES_PER_SEARCH = 0.05, 20
"""Memory of the process is read each time; its child processes are searched less often, because that takes milliseconds."""
PAIR_COUNTS = {"matched_pairs": "matches", "verified_pairs": "two_view_geometries"}
"""Names of the results, and the tables of the database that have a row per pair."""


def measure(task: RenderedSet, work: Path, options: tuple[str, ...]) -> dict[str, Any]:
    """Reconstruct a set in a new folder below `work` and score the result.

    Args:
        task: the images and the truth.
        work: folder of the output and of the log.
        options: further options of `epipole reconstruct`.

    Raises:
        ChildProcessError: the command failed.
    """
    out, log = work / "model", work / "reconstruct.log"
    shutil.rmtree(out, ignore_errors=True)
    known = () if task.camera_params is None else ("--camera-params", ",".join(map(repr, task.camera_params)))
    program = str(Path(sys.executable).with_name("epipole"))
    command = [program, "reconstruct", str(task.images), str(out), "--threads", str(NUM_THREADS)]
    before = processor_seconds()
    wall_s, peak_mb = run_watched([*command, *known, *options], log)
    own_s, machine_s = processor_seconds() - before
    summary = json.loads((out / "summary.json").read_text())
    return {
        "set": task.name,
        "images": len(task.names),
        "registered": summary["num_registered"],
        "models": len(summary["models"]),
        **count_pairs(out / "database.db"),
        "points": summary["num_points"],
        "observations": summary["num_observations"],
        "render_s": task.render_s,
        "wall_s": wall_s,
        "cpu_s": own_s,
        "others_cpu_s": machine_s - own_s,
        "compile_s": summary["compile_seconds"],
        "timings_s": summary["timings_s"],
        "tree_peak_mb": peak_mb,
        "stage_peak_mb": summary["peak_memory_mb"],
        "is_metric": summary["is_metric"],
        "reprojection_px": summary["mean_reprojection_error_px"],
        "cameras": summary["cameras"],
        "warnings": summary["warnings"],
        **score(task, out),
    }


def run_watched(command: list[str], log: Path) -> tuple[float, float]:
    """Run a command; returns wall seconds and the largest resident memory of its processes in MB.

    Args:
        command: the program and its arguments.
        log: file for its output.

    Raises:
        ChildProcessError: the command failed.
    """
    peak, sample, start = 0, 0, perf_counter()
    children: list[psutil.Process] = []
    with log.open("wb") as stream:
        process = psutil.Popen(command, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT)
        while process.poll() is None:
            if sample % SAMPLES_PER_SEARCH == 0:
                children = process.children(recursive=True)
            peak = max(peak, sum(_resident_bytes(one) for one in (process, *children)))
            sample += 1
            with suppress(psutil.TimeoutExpired):
                process.wait(SAMPLE_EVERY_S)
    if process.returncode:
        raise ChildProcessError(f"{command[1]} failed with exit code {process.returncode}: see {log}.")
    return perf_counter() - start, peak / 1e6


def _resident_bytes(process: psutil.Process) -> int:
    """Resident memory; 0 if the process has ended."""
    try:
        return process.memory_info().rss
    except psutil.Error:
        return 0


def processor_seconds() -> np.ndarray:
    """(2,) processor seconds of ended child processes, and of the machine without this process (NaN outside Linux)."""
    times, stat = os.times(), Path("/proc/stat")
    machine = np.nan
    if stat.is_file():
        user, nice, system = map(int, stat.read_text().split()[1:4])
        machine = (user + nice + system) / os.sysconf("SC_CLK_TCK") - times.user - times.system
    return np.array([times.children_user + times.children_system, machine])


def count_pairs(database: Path) -> dict[str, int]:
    """Number of pairs with matches, and of pairs with a verified geometry."""
    with closing(sqlite3.connect(database)) as connection:
        return {
            name: connection.execute(f"SELECT COUNT(*) FROM {table} WHERE rows > 0").fetchone()[0]
            for name, table in PAIR_COUNTS.items()
        }


def score(task: RenderedSet, out: Path) -> dict[str, float]:
    """Errors of the largest model in meters after the best similarity and, with GPS, in meters east, north and up without alignment."""
    model, _ = largest_model(out / "sparse")
    if model is None:
        return {}
    estimated = cams_in_order(model, task.names)
    errors = camera_errors(estimated, task.cams_from_world)
    found = {
        "ate_rmse_m": _rmse(errors.position),
        "ate_median_m": errors.median_position,
        "ate_max_m": errors.max_position,
        "rotation_median_deg": errors.median_rotation_deg,
    }
    if task.lat_lon_alt is not None:
        off = position_errors(task, estimated, task.lat_lon_alt)
        flat = np.hypot(off[:, 0], off[:, 1])
        found |= {
            "gps_rmse_m": _rmse(np.linalg.norm(off, axis=1)),
            "gps_flat_median_m": float(np.nanmedian(flat)),
            "gps_flat_max_m": float(np.nanmax(flat)),
            "gps_up_median_m": float(np.nanmedian(np.abs(off[:, 2]))),
            "gps_scale": float(errors.alignment.truth_from_estimated.scale),
        }
    return found


def position_errors(task: RenderedSet, estimated: Rigid3, lat_lon_alt: np.ndarray) -> np.ndarray:
    """(n, 3) estimated minus true positions, in the frame of the model: about the median of the fixes.

    Args:
        task: images with GPS in their EXIF.
        estimated: cams_from_world of its images, NaN for missing ones.
        lat_lon_alt: (n, 3) true positions.
    """
    fixes = [read_header(task.images / name).gps for name in task.names]
    table = np.array([(np.nan,) * 3 if fix is None else fix for fix in fixes], np.float64)
    return estimated.centers() - enu_about(lat_lon_alt, np.nanmedian(table, axis=0))


def _rmse(distances: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(distances**2)))


def main() -> None:
    """Render, reconstruct, and print one table."""
    parser = argparse.ArgumentParser(description="Large sets of rendered images, end to end.")
    parser.add_argument("--set", nargs="+", choices=list(SETS), default=["loop_room", "street"])
    parser.add_argument("--images", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=REPOSITORY / "build" / "large_sets")
    parser.add_argument(
        "--option", nargs="*", default=[], help="options of `epipole reconstruct`, without --"
    )
    arguments = parser.parse_args()
    options = tuple(f"--{option}" for option in arguments.option)
    rows = []
    for name in arguments.set:
        task = prepare_set(name, arguments.images, arguments.out)
        rows.append(measure(task, task.images.parent, options))
    report = {"machine": describe_machine(NUM_THREADS), "options": options, "sets": rows}
    (arguments.out / f"large_sets_{arguments.images}.json").write_text(json.dumps(report, indent=1) + "\n")
    console = Console(width=100)
    console.print(table_of(rows))
    for row in rows:
        for warning in row["warnings"]:
            console.print(f"{row['set']}: {warning}", markup=False)


def table_of(rows: list[dict[str, Any]]) -> Table:
    """A column per set, and a line per figure."""
    table = Table(title="large rendered sets, two threads")
    table.add_column("")
    for row in rows:
        table.add_column(f"{row['set']} ({row['images']:,})", justify="right")

    def add(label: str, key: str, form: str) -> None:
        if any(row.get(key) is not None for row in rows):
            table.add_row(label, *("" if row.get(key) is None else format(row[key], form) for row in rows))

    for key in ("registered", "models", "matched_pairs", "verified_pairs", "points", "observations"):
        add(key.replace("_", " "), key, ",")
    add("rendering, s", "render_s", ".0f")
    add("reconstruct, s", "wall_s", ".0f")
    add("  processor seconds", "cpu_s", ".0f")
    add("  processor seconds of everything else", "others_cpu_s", ".0f")
    add("  of which compiling, s", "compile_s", ".0f")
    for stage in dict.fromkeys(stage for row in rows for stage in row["timings_s"]):
        table.add_row(f"  {stage}, s; peak MB up to its end", *(_stage_of(row, stage) for row in rows))
    add("peak memory of all processes, MB", "tree_peak_mb", ",.0f")
    add("reprojection error, px", "reprojection_px", ".3f")
    for key in ("ate_rmse_m", "ate_median_m", "ate_max_m"):
        add(f"{key[:-2].replace('_', ' ').replace('ate', 'ATE')} (similarity), m", key, ".4f")
    add("rotation median, deg", "rotation_median_deg", ".4f")
    add("metric", "is_metric", "")
    add("error as georeferenced: RMSE, m", "gps_rmse_m", ".3f")
    add("  horizontal median, m", "gps_flat_median_m", ".3f")
    add("  horizontal maximum, m", "gps_flat_max_m", ".3f")
    add("  vertical median, m", "gps_up_median_m", ".3f")
    add("  true scale / scale", "gps_scale", ".5f")
    return table


def _stage_of(row: dict[str, Any], stage: str) -> str:
    """Seconds and memory of a stage, from summary.json; empty if the run did not have it."""
    if stage not in row["timings_s"]:
        return ""
    memory = (row["stage_peak_mb"] or {}).get(stage)
    return f"{row['timings_s'][stage]:.1f}" + ("" if memory is None else f"; {memory:,.0f}")


if __name__ == "__main__":
    main()
