"""Images a second of Gaussians and of a neural field at the same likeness, on lego. `python -m benchmarks.splat_against_nerf`.

Gaussians are trained for as long as the field, with different numbers of them: at the field's PSNR their speed lies between those of two rows.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import epipole
from benchmarks.measure import REPOSITORY, describe_machine
from epipole.fields.splat.rasterizer import render
from epipole.fields.training_view import TrainingView
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.images import gather_field_images
from epipole.pipelines.fields.kinds import KINDS

RESULTS = REPOSITORY / "benchmarks" / "results" / "splat_against_nerf.json"
COUNTS = (1000, 2000, 4000, 8000, 16000)
ROUNDS = 3


def frames_a_second(draw: Callable[[TrainingView], object], views: list[TrainingView]) -> float:
    """The best of some rounds over all views."""
    draw(views[0])
    seconds = []
    for _ in range(ROUNDS):
        start = perf_counter()
        for view in views:
            draw(view)
        seconds.append(perf_counter() - start)
    return len(views) / min(seconds)


def measured(source: Path, time: str, folder: Path) -> dict[str, Any]:
    """A row of the field, and one of each number of Gaussians."""
    views = gather_field_images(source, FieldOptions()).test
    field = epipole.nerf(source, folder / "nerf", time=time, kind="hash")
    white, draw = np.ones(3, np.float32), KINDS["hash"].render
    speed = frames_a_second(lambda view: draw(field.field, view.camera, view.cam_from_world, white), views)
    nerf, rows = {"psnr": field.summary["psnr"], "frames_s": speed}, []
    for count in COUNTS:
        found = epipole.splat(source, folder / str(count), time=time, max_gaussians=count)

        def draw_splat(view: TrainingView, cloud: Any = found.cloud) -> np.ndarray:
            return render(cloud, view.camera, view.cam_from_world).over(white)

        row = {"psnr": found.summary["psnr"], "frames_s": frames_a_second(draw_splat, views)}
        rows.append({"gaussians": len(found.cloud), **row})
    photometric_loss, speeds = ([row[name] for row in rows] for name in ("psnr", "frames_s"))
    equal = float(np.interp(nerf["psnr"], photometric_loss, speeds))
    ratio = equal / nerf["frames_s"]
    return {"time": time, "nerf": nerf, "splats": rows, "frames_s_at_equal_psnr": equal, "ratio": ratio}


def main() -> None:
    """Measure, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--time", default="60s", help="that each is trained for")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    with tempfile.TemporaryDirectory(prefix="epipole-fields-") as folder:
        found = measured(data / "fields" / "lego", arguments.time, Path(folder))
    RESULTS.write_text(json.dumps({"machine": describe_machine(2), **found}, indent=1) + "\n")
    table = Table("", "Gaussians", "PSNR", "images a second")
    table.add_row("neural field", "", f"{found['nerf']['psnr']:.2f}", f"{found['nerf']['frames_s']:.1f}")
    for row in found["splats"]:
        table.add_row("splats", f"{row['gaussians']:,}", f"{row['psnr']:.2f}", f"{row['frames_s']:.0f}")
    console = Console()
    console.print(table)
    console.print(
        f"at the field's PSNR: {found['frames_s_at_equal_psnr']:.0f} a second, {found['ratio']:.0f} times as many"
    )


if __name__ == "__main__":
    main()
