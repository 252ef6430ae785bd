"""Time of a Gaussian training step by phase, compared with the peak speed of the processor. `python -m benchmarks.splat_step`.

The steps are late ones of a training of fountain-P11, with the final number of Gaussians and full image size.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import epipole
from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.rasterizer import FLOPS
from epipole.fields.config import SplatTraining
from epipole.fields.splat import numba_backend
from epipole.fields.splat import trainer as splat_trainer
from epipole.fields.splat.gaussian_adam import GaussianAdam
from epipole.fields.splat.trainer import SplatTrainer
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.first_gaussians import first_gaussians
from epipole.pipelines.fields.images import gather_field_images

RESULTS = REPOSITORY / "benchmarks" / "results" / "splat_step.json"
SIZES = {384: 12_288, 768: 48_400}
"""Final number of Gaussians, by image width in pixels."""
PEAK = 157e9
"""Single-precision operations per second of two cores at 2.45 GHz."""
PHASES = {
    "tiles_of": "project, sort, assign to tiles",
    "blend": "blend",
    "photometric_loss": "photometric loss (L1, SSIM)",
    "depth_loss": "depth loss",
    "sums_of_pairs": "blend, backward",
    "gradient_of": "project, backward",
    "adam": "Adam",
}
"""Headings of the phases."""
PARTS = {name: (numba_backend, name) for name in ("tiles_of", "blend", "sums_of_pairs", "gradient_of")} | {
    "photometric_loss": (splat_trainer, "photometric_loss"),
    "depth_loss": (splat_trainer, "depth_loss"),
    "adam": (GaussianAdam, "step"),
}
"""Owner and name of the function that is timed for each phase."""


def timed(function: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    """Wrap a function so that it adds its seconds to `spent[name]`."""

    def wrapper(*positional: Any, **named: Any) -> Any:
        start = perf_counter()
        result = function(*positional, **named)
        spent[name] += perf_counter() - start
        if name == "blend":
            spent["pairs"] += result.num_evaluated
        return result

    return wrapper


def trained(model: Path, photographs: Path, width: int, steps: int) -> SplatTrainer:
    """A trainer near the end of its training."""
    images = gather_field_images(model, FieldOptions(max_side_px=width, test="0005.jpg"), photographs)
    config = SplatTraining(max_gaussians=SIZES[width])
    start = first_gaussians(images, config, SIZES[width], lambda *_: None)
    trainer = SplatTrainer(images.train, start.cloud, config, np.zeros(3, np.float32))
    for step in range(steps):
        trainer.step(0.9 * step / steps)
    return trainer


def measured(trainer: SplatTrainer, rounds: int) -> dict[str, Any]:
    """Median milliseconds of a step and its phases, and number of Gaussian-pixel pairs."""
    spent: dict[str, float] = defaultdict(float)
    originals = {name: getattr(owner, function) for name, (owner, function) in PARTS.items()}
    rows = []
    try:
        for name, (owner, function) in PARTS.items():
            setattr(owner, function, timed(originals[name], name, spent))
        for _ in range(rounds):
            spent.clear()
            start = perf_counter()
            trainer.step(0.95)
            rows.append({**spent, "step": perf_counter() - start})
    finally:
        for name, (owner, function) in PARTS.items():
            setattr(owner, function, originals[name])
    medians = {name: median(row[name] for row in rows) for name in ("step", "pairs", *PHASES)}
    pairs = medians.pop("pairs")
    return {
        "gaussians": len(trainer),
        "pairs": pairs,
        "ms": {name: 1e3 * seconds for name, seconds in medians.items()},
        "gflop_of_pairs": sum(FLOPS) * pairs / 1e9,
        "floor_ms": 1e3 * sum(FLOPS) * pairs / PEAK,
    }


def main() -> None:
    """Train, measure, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    photographs = data / "sfm" / "fountain-P11" / "images"
    with tempfile.TemporaryDirectory(prefix="epipole-step-") as folder:
        epipole.reconstruct(photographs, folder)
        rows = {
            str(width): measured(trained(Path(folder), photographs, width, arguments.steps), arguments.rounds)
            for width in SIZES
        }
    RESULTS.write_text(json.dumps({"machine": describe_machine(2), "rows": rows}, indent=1) + "\n")
    table = Table("milliseconds per step", *(f"fountain-P11, {width} px" for width in SIZES))
    for name, words in {"step": "total", **PHASES}.items():
        table.add_row(words, *(f"{row['ms'][name]:.2f}" for row in rows.values()))
    table.add_row("Gaussians", *(f"{row['gaussians']:,}" for row in rows.values()))
    table.add_row("million pairs", *(f"{row['pairs'] / 1e6:.2f}" for row in rows.values()))
    table.add_row("GFLOP of the pairs", *(f"{row['gflop_of_pairs']:.3f}" for row in rows.values()))
    table.add_row("lower bound, ms at 157 GFLOP/s", *(f"{row['floor_ms']:.2f}" for row in rows.values()))
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
