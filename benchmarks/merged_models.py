"""Two halves of a set, merged, beside one model of the whole set: `python -m benchmarks.merged_models`.

- temple: 47 images around a model temple (Middlebury), with its published camera; the halves have eight images in common at one end, and
  none at the other.
- street: 140 rendered images along a street without GPS; the halves overlap by 20 images, of which each has every other one, so that no image
  is in both. Each seed is another street.

Errors are those of the camera centers after a similarity to the true poses. A street has no loop, so its error is the sum of many small
random ones, and a single ratio of two such errors is of little use: the RMS over several streets is compared.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.tasks.rendered_sets import prepare_set
from benchmarks.tasks.sfm import data_root, prepare
from epipole.geometry import align_points
from epipole.io.colmap.model import read_colmap_model
from epipole.io.truth import read_truth

STREET_IMAGES, STREET_OVERLAP = 140, 20
SEEDS = (3, 4, 5, 6, 7)
"""Streets."""


@dataclass(frozen=True, slots=True, eq=False)
class MergeTask:
    """Image files, the two halves, and the true camera centers by name."""

    paths: tuple[Path, ...]
    halves: tuple[np.ndarray, np.ndarray]
    """Rows of `paths`."""
    options: tuple[str, ...]
    centers: dict[str, np.ndarray]


def temple_task(work: Path, data: Path) -> MergeTask:
    """Halves of the ring."""
    task = prepare("temple_ring", data, work)
    truth = read_truth(task.truth)
    centers = dict(zip(truth.names, truth.cams_from_world.centers()))
    paths = tuple(sorted(path for path in task.images.glob("*.png") if path.name in centers))
    n = len(paths)
    camera = ("--camera-model", "PINHOLE", "--camera-params", ",".join(map(str, task.camera_params or ())))
    halves = (np.arange(n // 2 + 4), np.arange(n // 2 - 4, n))
    return MergeTask(paths, halves, camera, centers)


def street_task(work: Path, seed: int) -> MergeTask:
    """Halves of a street that share no image."""
    street = prepare_set("street", STREET_IMAGES, work, seed)
    paths = tuple(street.images / name for name in street.names)
    middle, half = STREET_IMAGES // 2, STREET_OVERLAP // 2
    between = np.arange(middle - half, middle + half)
    halves = (
        np.concatenate([np.arange(middle - half), between[::2]]),
        np.concatenate([between[1::2], np.arange(middle + half, STREET_IMAGES)]),
    )
    centers = dict(zip(street.names, street.cams_from_world.centers()))
    return MergeTask(paths, halves, ("--mapper.no-use-gps",), centers)


def run(words: list[str]) -> float:
    """Wall seconds of a command in a separate process."""
    start = perf_counter()
    subprocess.run([sys.executable, "-m", "epipole", *words, "-q"], check=True, capture_output=True)
    return perf_counter() - start


def link(paths: list[Path], folder: Path) -> Path:
    """A folder with links to images."""
    folder.mkdir(parents=True)
    for path in paths:
        (folder / path.name).symlink_to(path.resolve())
    return folder


def error_of(out: Path, centers: dict[str, np.ndarray]) -> tuple[int, float]:
    """Number of registered images and root mean square of their position errors, relative to the extent of the cameras in percent."""
    model = read_colmap_model(out / "sparse" / "0")
    found, true = model.camera_centers_in_world(), np.array([centers[name] for name in model.images.name])
    off = align_points(found, true).apply(found) - true
    extent = float(np.linalg.norm(np.ptp(np.array(list(centers.values())), axis=0)))
    return len(found), 100.0 * float(np.sqrt((off**2).sum(axis=1).mean())) / extent


def measure(task: MergeTask, at: Path) -> dict[str, float]:
    """Times and errors of one set."""
    shutil.rmtree(at, ignore_errors=True)
    whole = link(list(task.paths), at / "images")
    whole_s = run(["reconstruct", str(whole), str(at / "whole"), *task.options])
    halves = []
    for number, rows in enumerate(task.halves):
        images = link([task.paths[row] for row in rows.tolist()], at / f"images_{number}")
        halves.append(str(at / f"half_{number}"))
        run(["reconstruct", str(images), halves[-1], *task.options])
    merged_s = run(["merge", *halves, str(at / "merged"), *task.options])
    summary = json.loads((at / "merged" / "summary.json").read_text())
    num_whole, whole_error = error_of(at / "whole", task.centers)
    num_merged, merged_error = error_of(at / "merged", task.centers)
    return {
        "images": len(task.paths),
        "registered (whole)": num_whole,
        "registered (merged)": num_merged,
        "is joined": float(summary["models"][0]["mapper"] == "grown"),
        "whole, s": whole_s,
        "merged, s": merged_s,
        "whole, error in % of the extent": whole_error,
        "merged, error in % of the extent": merged_error,
        "ratio of the errors": merged_error / whole_error,
    }


def in_words(streets: list[dict[str, float]]) -> str:
    """Ratio of the errors of all streets together, and of single ones."""
    whole, merged = (
        float(np.sqrt(np.mean([row[f"{kind}, error in % of the extent"] ** 2 for row in streets])))
        for kind in ("whole", "merged")
    )
    ratios = [row["ratio of the errors"] for row in streets]
    return (
        f"RMS over {len(streets)} streets: {whole:.4f} % (whole), {merged:.4f} % (merged), ratio {merged / whole:.3f}; "
        f"ratios of single streets {min(ratios):.2f} to {max(ratios):.2f}, median {np.median(ratios):.2f}"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, default=REPOSITORY / "build" / "merged_models")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--sets", nargs="+", default=["temple", "street"], choices=["temple", "street"])
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS)
    arguments = parser.parse_args()
    rows = {}
    if "temple" in arguments.sets:
        task = temple_task(arguments.work, data_root(arguments.data))
        rows["temple"] = measure(task, arguments.work / "temple")
    for seed in arguments.seeds if "street" in arguments.sets else ():
        rows[f"street {seed}"] = measure(
            street_task(arguments.work, seed), arguments.work / f"street_seed_{seed}"
        )
    table = Table("", *rows, title="Two halves merged")
    for key in next(iter(rows.values())):
        table.add_row(key, *(f"{row[key]:.4g}" for row in rows.values()))
    Console().print(table)
    streets = [row for name, row in rows.items() if name.startswith("street")]
    if streets:
        Console().print(in_words(streets))
    out = REPOSITORY / "benchmarks" / "results" / "merged_models.json"
    out.write_text(
        json.dumps({"machine": describe_machine(2), "sets": rows}, indent=1) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
