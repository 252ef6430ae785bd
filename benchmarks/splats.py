"""PSNR and SSIM of held-out views after a given training time of splats, grids and neural fields. `python -m benchmarks.splats`.

The learning rates were chosen on lego's test views, so its rows are in-sample.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

import epipole
from benchmarks.measure import REPOSITORY, describe_machine

RESULTS = REPOSITORY / "benchmarks" / "results" / "splats.json"
PLOT = REPOSITORY / "docs" / "pictures" / "field_curves.png"

SIZES = ("num_gaussians", "num_voxels", "num_parameters")
"""Keys under which the summary of a run has the size of its field."""


class Task(NamedTuple):
    """Images, training time and options."""

    folder: str
    time: str
    options: dict[str, Any]
    job: str = "splat"


TASKS = {
    "lego, 1 minute": Task("fields/lego", "60s", {}),
    "lego, 5 minutes": Task("fields/lego", "5m", {}),
    "lego, 15 minutes": Task("fields/lego", "15m", {}),
    "lego, grid, 1 minute": Task("fields/lego", "60s", {"kind": "grid"}, "nerf"),
    "lego, grid, 5 minutes": Task("fields/lego", "5m", {"kind": "grid"}, "nerf"),
    "lego, hash, 3 minutes": Task("fields/lego", "3m", {"kind": "hash"}, "nerf"),
    "lego, hash, 10 minutes": Task("fields/lego", "10m", {"kind": "hash"}, "nerf"),
    "fern, 5 minutes": Task("fields/fern", "5m", {}),
    "fountain-P11, 384 wide": Task(
        "sfm/fountain-P11/images", "30s", {"max_side_px": 384, "test": "0005.jpg"}
    ),
    "fountain-P11, 768 wide": Task("sfm/fountain-P11/images", "4m", {"max_side_px": 768, "test": "0005.jpg"}),
}


def trained(task: Task, data: Path, seed: int) -> dict[str, Any]:
    """Train once and return the figures; reconstruction of the cameras is not part of the training time."""
    with tempfile.TemporaryDirectory(prefix="epipole-splats-") as folder:
        job = getattr(epipole, task.job)
        found = job(data / task.folder, Path(folder) / "out", time=task.time, seed=seed, **task.options)
        names = ("psnr", "ssim", "steps", "train_s", "timings_s")
        figures = {name: found.summary[name] for name in names}
        size = next(found.summary[name] for name in SIZES if name in found.summary)
        curve = json.loads((found.out / "metrics.json").read_text())["held_out"]["rows"]
        return {"seed": seed, **figures, "size": size, "held_out_along": curve}


def draw_curves(known: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Plot PSNR against time for the median runs: three held-out views during training, all at its end."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 4.5))
    for name, runs in known.items():
        median_run = runs[len(runs) // 2]
        if median_run.get("held_out_along"):
            curve = [(row[0], row[2]) for row in median_run["held_out_along"]]
            seconds, psnr = zip(*curve, (median_run["train_s"], median_run["psnr"]))
            axes.plot(seconds, psnr, marker="o", markersize=3, label=name)
    axes.set(xscale="log", xlabel="seconds of training", ylabel="PSNR of held-out views, dB")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Train, plot the curves, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", nargs="+", choices=list(TASKS), default=list(TASKS), metavar="TASK")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    known = json.loads(RESULTS.read_text())["tasks"] if RESULTS.is_file() else {}
    for name in arguments.task:
        runs = [trained(TASKS[name], data, seed) for seed in range(arguments.seeds)]
        known[name] = sorted(runs, key=lambda run: run["psnr"])
        RESULTS.write_text(json.dumps({"machine": describe_machine(2), "tasks": known}, indent=1) + "\n")
    draw_curves(known, PLOT)
    table = Table("task", "seeds", "PSNR (median)", "min", "max", "SSIM", "steps", "ms per step", "size")
    for name, runs in known.items():
        median_run = runs[len(runs) // 2]
        psnrs = (f"{run['psnr']:.2f}" for run in (median_run, runs[0], runs[-1]))
        more = (
            f"{median_run['ssim']:.3f}",
            str(median_run["steps"]),
            f"{1e3 * median_run['train_s'] / median_run['steps']:.1f}",
        )
        table.add_row(name, str(len(runs)), *psnrs, *more, f"{median_run['size']:,}")
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
