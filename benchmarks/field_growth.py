"""Time and memory of a training step against Gaussians and pixels (harmonics of degree 3). `python -m benchmarks.field_growth`.

Each size runs in its own process. Memory per Gaussian is the difference from a process with a thousand Gaussians.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.rasterizer import multiplied
from epipole.fields.config import SplatTraining
from epipole.fields.splat.rasterizer import render
from epipole.fields.splat.trainer import SplatTrainer
from epipole.fields.training_view import TrainingView
from epipole.io.gaussians.files import read_gaussians
from epipole.pipelines.fields.cameras import orbit
from epipole.pipelines.fields.config import RenderConfig
from epipole.pipelines.fields.scene import seen_gaussians

RESULTS = REPOSITORY / "benchmarks" / "results" / "field_growth.json"
SMALLEST_COUNT = 1000
COUNTS = (100_000, 200_000, 400_000, 700_000, 1_000_000)
"""Gaussians, at DEFAULT_SIDE."""
SIDES = (200, 400, 600, 800)
"""Pixels per side of the images, at DEFAULT_COUNT."""
DEFAULT_COUNT = 200_000
DEFAULT_SIDE = 400
NUM_VIEWS = 8
GROWING_STEPS = 40
"""Steps in which Gaussians are split and removed, before the measured ones."""


def measured(source: Path, count: int, side: int, steps: int) -> dict[str, float]:
    """Median seconds of a step with `count` Gaussians and images of `side` x `side`, and peak memory in bytes."""
    (_, known), guitar = seen_gaussians(source), read_gaussians(source)
    job = RenderConfig(frames=NUM_VIEWS, width=side, height=side)
    shots = orbit(known.position, known.look_at, known.up, job)
    views = []
    for shot in shots:
        rendered = render(guitar, shot.camera, shot.cam_from_world).over(np.zeros(3, np.float32))
        image = np.rint(255 * np.clip(rendered, 0, 1)).astype(np.uint8)
        views.append(TrainingView(shot.name, image, shot.camera, shot.cam_from_world))
    config = SplatTraining(max_gaussians=count)
    trainer = SplatTrainer(views, multiplied(guitar, count // 4), config, np.zeros(3, np.float32))
    for step in range(GROWING_STEPS):
        trainer.step(0.599 * step / GROWING_STEPS)
    seconds = []
    for _ in range(steps):
        start = perf_counter()
        trainer.step(0.9)
        seconds.append(perf_counter() - start)
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"gaussians": len(trainer), "pixels": side * side, "step_s": median(seconds), "bytes": peak}


def measured_in_process(data: Path, count: int, side: int, steps: int) -> dict[str, float]:
    """`measured` in a new process, because peak memory never decreases."""
    command = [sys.executable, "-m", "benchmarks.field_growth", "--data", str(data)]
    command += ["--one", str(count), str(side), "--steps", str(steps)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def fit_line(rows: list[dict[str, float]], name: str) -> dict[str, float]:
    """Straight line of seconds against a quantity: value at 0, slope per million, and R^2."""
    x, y = (np.array([row[part] for row in rows]) for part in (name, "step_s"))
    slope, start = np.polyfit(x, y, 1)
    residuals = y - start - slope * x
    return {
        "start_s": float(start),
        "s_per_million": 1e6 * float(slope),
        "explained": 1 - float(residuals.var() / y.var()),
    }


def main() -> None:
    """Measure, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=15)
    parser.add_argument("--one", type=int, nargs=2, metavar=("COUNT", "SIDE"), help="measure one size only")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    if arguments.one:
        source = data / "fields" / "splats" / "guitar.compressed.ply"
        print(json.dumps(measured(source, *arguments.one, arguments.steps)))
        return
    by_count = [
        measured_in_process(data, count, DEFAULT_SIDE, arguments.steps) for count in (SMALLEST_COUNT, *COUNTS)
    ]
    by_side = [measured_in_process(data, DEFAULT_COUNT, side, arguments.steps) for side in SIDES]
    smallest, largest = by_count[0], by_count[-1]
    memory = (largest["bytes"] - smallest["bytes"]) / (largest["gaussians"] - smallest["gaussians"])
    lines = {"gaussians": fit_line(by_count[1:], "gaussians"), "pixels": fit_line(by_side, "pixels")}
    results = {"by_gaussians": by_count, "by_pixels": by_side, "lines": lines, "bytes_per_gaussian": memory}
    RESULTS.write_text(json.dumps({"machine": describe_machine(2), **results}, indent=1) + "\n")
    table = Table("Gaussians", "pixels", "ms per step", "memory, MB")
    for row in (*by_count, *by_side):
        table.add_row(
            f"{row['gaussians']:,.0f}",
            f"{row['pixels']:,.0f}",
            f"{1e3 * row['step_s']:.1f}",
            f"{row['bytes'] / 1e6:.0f}",
        )
    console = Console()
    console.print(table)
    for name, found in lines.items():
        explained = f"a line explains {100 * found['explained']:.1f} % of the variance"
        console.print(f"per million {name}: {found['s_per_million']:.3f} s per step ({explained})")
    console.print(f"memory: {memory / 1e3:.2f} GB per million Gaussians")


if __name__ == "__main__":
    main()
