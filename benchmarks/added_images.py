"""Five images added to a model of about a hundred: `python -m benchmarks.added_images`.

Frames of the kitchen (7-Scenes) with a known camera: a run of all of them, and a run of all but five that then grows by these. Errors are
those of the camera centers after a similarity to the published poses.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.tasks.sfm import data_root
from epipole.geometry import align_points
from epipole.io.colmap.model import read_colmap_model

NUM_IMAGES, NUM_ADDED, LAST_FRAME = 110, 5, 310
CAMERA = ("--camera-model", "PINHOLE", "--camera-params", "525.5,525.5,320.5,240.5")


def reconstruct(images: Path, out: Path, *more: str) -> float:
    """Wall seconds of the command in a separate process."""
    command = [sys.executable, "-m", "epipole", "reconstruct", str(images), str(out), *CAMERA, "-q", *more]
    start = perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return perf_counter() - start


def rmse_mm(out: Path, truth: dict[str, np.ndarray]) -> float:
    """Root mean square of the position errors, in millimeters."""
    model = read_colmap_model(out / "sparse" / "0")
    found, true = model.camera_centers_in_world(), np.array([truth[name] for name in model.images.name])
    off = align_points(found, true).apply(found) - true
    return float(1e3 * np.sqrt((off**2).sum(axis=1).mean()))


def link(paths: list[Path], folder: Path) -> None:
    """Fill a folder with links."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in paths:
        if not (folder / path.name).exists():
            (folder / path.name).symlink_to(path)


def measure(work: Path, data: Path) -> dict[str, float]:
    """Time and error of both runs."""
    shutil.rmtree(work, ignore_errors=True)
    source = data / "slam" / "7scenes"
    rows = [row for row in np.loadtxt(source / "poses_sfm.txt") if row[0] <= LAST_FRAME]
    truth = {f"frame-{int(row[0]):06d}.color.jpg": row[1:4] for row in rows}
    paths = [source / name for name in truth if (source / name).is_file()]
    chosen = [paths[k] for k in np.linspace(0, len(paths) - 1, NUM_IMAGES).astype(int)]
    added = [chosen[k] for k in np.linspace(10, NUM_IMAGES - 10, NUM_ADDED).astype(int)]
    link(chosen, work / "all")
    link([path for path in chosen if path not in added], work / "growing")
    fresh_s = reconstruct(work / "all", work / "fresh")
    reconstruct(work / "growing", work / "grown")
    link(added, work / "growing")
    grown_s = reconstruct(work / "growing", work / "grown", "--grow")
    summary = json.loads((work / "grown" / "summary.json").read_text())
    return {
        "registered": summary["num_registered"],
        "is_grown": float(summary["models"][0]["mapper"] == "grown"),
        "fresh_s": fresh_s,
        "grown_s": grown_s,
        "time_ratio": grown_s / fresh_s,
        "fresh_rmse_mm": rmse_mm(work / "fresh", truth),
        "grown_rmse_mm": rmse_mm(work / "grown", truth),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, default=REPOSITORY / "build" / "added_images")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--data", type=Path)
    arguments = parser.parse_args()
    runs = [measure(arguments.work, data_root(arguments.data)) for _ in range(arguments.runs)]
    table = Table("", "median", "range", title="Five images added to a model")
    for name in runs[0]:
        values = [run[name] for run in runs]
        table.add_row(
            name.replace("_", " "), f"{np.median(values):.4g}", f"{min(values):.4g} to {max(values):.4g}"
        )
    Console().print(table)
    out = REPOSITORY / "benchmarks" / "results" / "added_images.json"
    out.write_text(
        json.dumps({"machine": describe_machine(2), "runs": runs}, indent=1) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
