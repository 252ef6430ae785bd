"""Time and memory of mapping against the number of images, without pixels: `python -m benchmarks.mapping_growth`.

The images of `benchmarks.tasks.streets` are mapped as `epipole reconstruct` maps them, each size in its own process. Memory is the
peak resident size, including the task. The exponent is the slope of time against observations in logarithms.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.tasks.streets import StreetTask, street_task
from epipole.geometry import align_points
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.look_alikes import Attempt, Separation, map_apart
from epipole.pipelines.sfm.mapping_stage import Detections, map_images
from epipole.pipelines.sfm.matching.pair_selection import consistent_pairs
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.pipelines.sfm.warm_up import warm_up
from epipole.runs import ignore_progress

SIZES = (250, 500, 1000, 3000)
_UNIT = 1 if sys.platform == "darwin" else 1024
"""Bytes per unit of `ru_maxrss`."""


def map_task(task: StreetTask, config: MapperConfig) -> Separation:
    """Map the images of a task."""
    n = task.num_images
    unknown, none = np.full((n, 3), np.nan), ("",) * n
    names = tuple(f"{i:06d}" for i in range(n))
    camera_of_image = np.zeros(n, np.int32)
    images = ImageSet(
        Path(),
        names,
        task.cameras,
        camera_of_image,
        ("given",),
        unknown,
        unknown,
        unknown[:, 0],
        none,
        none,
        {},
    )
    detections = Detections(task.keypoints, [np.zeros((len(k), 3), np.uint8) for k in task.keypoints], None)

    def map_pairs(used: np.ndarray) -> Attempt:
        graph, found_rad = consistent_pairs(
            task.view_graph.select(used), task.keypoints, task.cameras, camera_of_image, config
        )
        contradiction_rad = np.full(len(used), np.nan)
        contradiction_rad[used] = found_rad
        mapped = map_images(images, graph, detections, config, ignore_progress)
        return Attempt(mapped, graph, contradiction_rad)

    matched = np.stack([task.view_graph.image1, task.view_graph.image2], axis=1)
    return map_apart(task.view_graph, map_pairs, matched)


def measure(num_images: int, config: MapperConfig) -> dict[str, Any]:
    """Map one size: time, memory, and distance of the images from their true positions."""
    task = street_task(num_images)
    warm_up()
    start = perf_counter()
    models = map_task(task, config).last.mapped.models
    seconds = perf_counter() - start
    rows = np.flatnonzero(models[0].is_registered())
    found, truth = models[0].camera_centers_in_world()[rows], task.cams_from_world.centers()[rows]
    off_m = np.linalg.norm(align_points(found, truth).apply(found) - truth, axis=1)
    return {
        "images": num_images,
        "pairs": len(task.view_graph),
        "observations": len(models[0].tracks.image),
        "models": len(models),
        "registered": len(rows),
        "seconds": seconds,
        "rmse_m": float(np.sqrt(np.mean(off_m**2))),
        "max_m": float(off_m.max()),
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _UNIT / 1e9,
    }


def _serve(num_images: int, config: MapperConfig, connection: Any) -> None:
    connection.send(measure(num_images, config))


def exponent(rows: list[dict[str, Any]]) -> float:
    """Slope of seconds against observations in logarithms."""
    logs = np.log([[row["observations"], row["seconds"]] for row in rows])
    return float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0])


def main() -> None:
    """Map the sizes, print the table and write the results."""
    parser = argparse.ArgumentParser(description="Mapping of drives of different lengths.")
    parser.add_argument("--images", type=int, nargs="+", default=SIZES)
    parser.add_argument("--part-images", type=int, help="map in parts of this size; no results are written")
    parser.add_argument(
        "--method", choices=("auto", "incremental", "global"), default="auto", help="only auto writes results"
    )
    arguments = parser.parse_args()
    config = MapperConfig(method=arguments.method)
    if arguments.part_images is not None:
        config = replace(config, divide_above=1, part_images=arguments.part_images)
    context, rows = get_context("spawn"), []
    columns = (
        "images",
        "registered",
        "pairs",
        "observations",
        "seconds",
        "us / obs.",
        "peak GB",
        "rmse m",
        "max m",
    )
    table = Table(title="mapping of a drive through a town")
    for column in columns:
        table.add_column(column, justify="right")
    for num_images in arguments.images:
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_serve, args=(num_images, config, theirs))
        process.start()
        theirs.close()
        row = ours.recv()
        process.join()
        rows.append(row)
        table.add_row(
            *(f"{row[name]:,}" for name in ("images", "registered", "pairs", "observations")),
            *(f"{row['seconds']:.1f}", f"{1e6 * row['seconds'] / row['observations']:.1f}"),
            *(f"{row['peak_gb']:.2f}", f"{row['rmse_m']:.3f}", f"{row['max_m']:.3f}"),
        )
    found: dict[str, Any] = {"machine": describe_machine(0), "drives": rows}
    if len(rows) > 1:
        found["exponent"] = exponent(rows)
    file = REPOSITORY / "benchmarks" / "results" / "mapping_growth.json"
    if arguments.part_images is None and arguments.method == "auto":
        file.write_text(json.dumps(found, indent=1) + "\n")
    console = Console(width=120)
    console.print(table)
    if len(rows) > 1:
        console.print(f"seconds grow as observations to the power of {found['exponent']:.2f}")


if __name__ == "__main__":
    main()
