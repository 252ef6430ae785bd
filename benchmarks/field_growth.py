"""Seconds a step and memory against Gaussians and pixels, at harmonics of degree 3. `python -m benchmarks.field_growth`.

Each count is measured in its own process, whose memory is what it adds to that of a thousand Gaussians.
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
LEAST = 1000
COUNTS, SIDES = (100_000, 200_000, 400_000, 700_000, 1_000_000), (200, 400, 600, 800)
USUAL_COUNT, USUAL_SIDE = 200_000, 400
VIEWS, GROWING = 8, 40
"""Images, and steps in which Gaussians are still split and dropped."""


def measured(source: Path, count: int, side: int, steps: int) -> dict[str, float]:
    """Median seconds of a step of so many Gaussians and pixels, and the most memory that was used, in bytes."""
    (_, known), guitar = seen_gaussians(source), read_gaussians(source)
    job = RenderConfig(frames=VIEWS, width=side, height=side)
    shots = orbit(known.position, known.look_at, known.up, job)
    views = []
    for shot in shots:
        rendered = render(guitar, shot.camera, shot.cam_from_world).over(np.zeros(3, np.float32))
        image = np.rint(255 * np.clip(rendered, 0, 1)).astype(np.uint8)
        views.append(TrainingView(shot.name, image, shot.camera, shot.cam_from_world))
    config = SplatTraining(max_gaussians=count)
    trainer = SplatTrainer(views, multiplied(guitar, count // 4), config, np.zeros(3, np.float32))
    for step in range(GROWING):
        trainer.step(0.599 * step / GROWING)
    seconds = []
    for _ in range(steps):
        start = perf_counter()
        trainer.step(0.9)
        seconds.append(perf_counter() - start)
    most = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"gaussians": len(trainer), "pixels": side * side, "step_s": median(seconds), "bytes": most}


def apart(data: Path, count: int, side: int, steps: int) -> dict[str, float]:
    """The same, in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.field_growth", "--data", str(data)]
    command += ["--one", str(count), str(side), "--steps", str(steps)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def line(rows: list[dict[str, float]], name: str) -> dict[str, float]:
    """Seconds at 0, seconds more for a million, and the share of the variance that a straight line explains."""
    x, y = (np.array([row[part] for row in rows]) for part in (name, "step_s"))
    slope, start = np.polyfit(x, y, 1)
    rest = y - start - slope * x
    return {
        "start_s": float(start),
        "s_per_million": 1e6 * float(slope),
        "explained": 1 - float(rest.var() / y.var()),
    }


def main() -> None:
    """Measure, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=15)
    parser.add_argument("--one", type=int, nargs=2, metavar=("COUNT", "SIDE"), help="measure this alone")
    parser.add_argument("--data", type=Path, help="data folder (else $EPIPOLE_DATA, else ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    if arguments.one:
        source = data / "fields" / "splats" / "guitar.compressed.ply"
        print(json.dumps(measured(source, *arguments.one, arguments.steps)))
        return
    by_count = [apart(data, count, USUAL_SIDE, arguments.steps) for count in (LEAST, *COUNTS)]
    by_side = [apart(data, USUAL_COUNT, side, arguments.steps) for side in SIDES]
    empty, whole = by_count[0], by_count[-1]
    memory = (whole["bytes"] - empty["bytes"]) / (whole["gaussians"] - empty["gaussians"])
    lines = {"gaussians": line(by_count[1:], "gaussians"), "pixels": line(by_side, "pixels")}
    given = {"by_gaussians": by_count, "by_pixels": by_side, "lines": lines, "bytes_per_gaussian": memory}
    RESULTS.write_text(json.dumps({"machine": describe_machine(2), **given}, indent=1) + "\n")
    table = Table("Gaussians", "pixels", "ms a step", "memory, MB")
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
        explained = f"{100 * found['explained']:.1f} % of the variance"
        console.print(f"a million {name} more: {found['s_per_million']:.3f} s a step ({explained} on a line)")
    console.print(f"memory: {memory / 1e3:.2f} GB for a million Gaussians")


if __name__ == "__main__":
    main()
