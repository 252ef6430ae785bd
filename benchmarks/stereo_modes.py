"""Gain and cost of each option of dense stereo on the real pairs, and errors of hole filling. `python -m benchmarks.stereo_modes`.

Times are medians of the calls in one second, with two threads.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.side_by_side import table_of
from benchmarks.stereo_sigma import QUANTUM_PX, coverage
from benchmarks.tasks.stereo import StereoTask, figures, stereo_tasks
from epipole import _parallel
from epipole.disparity_search.search import match_stereo
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.filling import fill_disparities
from epipole.scene import DisparityMap
from epipole.synthetic.stereo_rooms import stereo_room

ENOUGH_S = 1.0
"""Time for which calls are repeated."""
LARGE_SIZE = (3000, 2200)
LARGE_DISPARITIES = 512
MODES: dict[str, dict[str, object]] = {
    "as it comes": {},
    "fast check": {"left_right": "fast"},
    "4 paths, fast check": {"paths": 4, "left_right": "fast"},
    "coarse to fine": {"search": "coarse_to_fine"},
    "brightness 8": {"brightness_cost": 8},
    "blocks of 9, fast check": {"method": "block", "left_right": "fast"},
    "blocks of 3, fast check": {"method": "block", "block_px": 3, "left_right": "fast"},
    "blocks of 15, fast check": {"method": "block", "block_px": 15, "left_right": "fast"},
    "no median": {"median_px": 0},
    "P1 of 5": {"small_penalty": 5},
    "sigma up to 0.25 px": {"max_sigma_px": 0.25},
}


def timed(left: np.ndarray, right: np.ndarray, config: StereoConfig) -> tuple[float, DisparityMap]:
    """(median seconds, disparities)."""
    match_stereo(left, right, config)  # compiles the kernels and allocates memory
    first_start, seconds = time.perf_counter(), []
    while not seconds or time.perf_counter() - first_start < ENOUGH_S:
        start = time.perf_counter()
        found = match_stereo(left, right, config)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds), found


def mode_rows(name: str, task: StereoTask) -> dict[str, dict[str, float]]:
    """Errors, time and coverage of the standard deviations for every mode, and errors of hole filling."""
    rows = {}
    for mode, options in MODES.items():
        config = StereoConfig(max_disparity_px=task.num_disparities - 1, **options)
        seconds, found = timed(task.left, task.right, config)
        error = np.abs(found.disparity_px - task.truth)
        known = np.isfinite(error)
        rows[mode] = figures(found.disparity_px, task) | {
            "seconds": seconds,
            "within one sigma %": coverage(error[known], found.sigma_px[known], QUANTUM_PX[name])["within %"],
        }
        if mode == "as it comes":
            filled = fill_disparities(found, task.left)
            scored = filled.filled_mask & np.isfinite(task.truth)
            wrong = np.abs(filled.disparity_px - task.truth)[scored] > 2
            filling = {"density %": 100.0 * float(scored.mean()), "bad 2 %": 100.0 * float(wrong.mean())}
    rows["guesses of filling (of all pixels)"] = filling
    return rows


def large_rows() -> dict[str, dict[str, float]]:
    """Time and errors of both searches over a large range of disparities."""
    pair = stereo_room(5, LARGE_SIZE)
    rows = {}
    for search in ("full", "coarse_to_fine"):
        seconds, found = timed(
            pair.left, pair.right, StereoConfig(max_disparity_px=LARGE_DISPARITIES - 1, search=search)
        )
        error = np.abs(found.disparity_px - pair.disparity_px)
        bad = 100.0 * float((error[np.isfinite(error)] > 1).mean())
        rows[search] = {"seconds": seconds, "known %": 100.0 * found.density, "bad 1 %": bad}
    return rows


def main() -> None:
    """Print the tables and write the results."""
    parser = argparse.ArgumentParser(description="Options of dense stereo.")
    parser.add_argument(
        "--large", action="store_true", help="compare both searches on a large rendered pair instead"
    )
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    _parallel.set_num_threads(2)
    console = Console(width=150)
    if arguments.large:
        title = f"{LARGE_SIZE[0]} x {LARGE_SIZE[1]} pixels, {LARGE_DISPARITIES} disparities"
        console.print(table_of(title, large_rows()))
        return
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    report: dict[str, object] = {"machine": describe_machine(2)}
    for name, task in stereo_tasks(data).items():
        report[name] = rows = mode_rows(name, task)
        console.print(table_of(name, rows))
    arguments.results.mkdir(parents=True, exist_ok=True)
    (arguments.results / "stereo_modes.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
