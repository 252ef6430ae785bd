"""Rendering speed of Gaussians and of a neural field at the same PSNR, on lego. `python -m benchmarks.splat_against_nerf`.

Different numbers of Gaussians are trained for the same time as the field; their speed at its PSNR is interpolated.
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
"""Maximum numbers of Gaussians."""
ROUNDS = 3


def frames_per_second(render_view: Callable[[TrainingView], object], views: list[TrainingView]) -> float:
    """The best of several rounds over all views."""
    render_view(views[0])
    seconds = []
    for _ in range(ROUNDS):
        start = perf_counter()
        for view in views:
            render_view(view)
        seconds.append(perf_counter() - start)
    return len(views) / min(seconds)


def measured(source: Path, time: str, folder: Path) -> dict[str, Any]:
    """PSNR and speed of the field, and of each number of Gaussians."""
    views = gather_field_images(source, FieldOptions()).test
    field = epipole.nerf(source, folder / "nerf", time=time, kind="hash")
    white, render_field = np.ones(3, np.float32), KINDS["hash"].render
    speed = frames_per_second(
        lambda view: render_field(field.field, view.camera, view.cam_from_world, white), views
    )
    nerf, rows = {"psnr": field.summary["psnr"], "frames_s": speed}, []
    for count in COUNTS:
        found = epipole.splat(source, folder / str(count), time=time, max_gaussians=count)

        def render_splat(view: TrainingView, cloud: Any = found.cloud) -> np.ndarray:
            return render(cloud, view.camera, view.cam_from_world).over(white)

        row = {"psnr": found.summary["psnr"], "frames_s": frames_per_second(render_splat, views)}
        rows.append({"gaussians": len(found.cloud), **row})
    psnrs, speeds = ([row[name] for row in rows] for name in ("psnr", "frames_s"))
    equal = float(np.interp(nerf["psnr"], psnrs, speeds))
    ratio = equal / nerf["frames_s"]
    return {"time": time, "nerf": nerf, "splats": rows, "frames_s_at_equal_psnr": equal, "ratio": ratio}


def main() -> None:
    """Measure, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--time", default="60s", help="training time of each field")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    with tempfile.TemporaryDirectory(prefix="epipole-fields-") as folder:
        found = measured(data / "fields" / "lego", arguments.time, Path(folder))
    RESULTS.write_text(json.dumps({"machine": describe_machine(2), **found}, indent=1) + "\n")
    table = Table("", "Gaussians", "PSNR", "images per second")
    table.add_row("neural field", "", f"{found['nerf']['psnr']:.2f}", f"{found['nerf']['frames_s']:.1f}")
    for row in found["splats"]:
        table.add_row("splats", f"{row['gaussians']:,}", f"{row['psnr']:.2f}", f"{row['frames_s']:.0f}")
    console = Console()
    console.print(table)
    console.print(
        f"at the field's PSNR: {found['frames_s_at_equal_psnr']:.0f} images per second, "
        f"{found['ratio']:.0f} times the field's speed"
    )


if __name__ == "__main__":
    main()
