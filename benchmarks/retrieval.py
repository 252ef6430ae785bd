"""Image retrieval against matching: `python -m benchmarks.retrieval --set kitchen-all`.

True neighbors of an image are those with at least `LEAST_INLIERS` verified matches: in the kitchen among all others, in the rendered street
of 1,000 images among those that the defaults match, the nearest by GPS. Retrieval sees no GPS. A finished run in the folder is used again. Its recall is the part of the true
neighbors that is among the most similar images; at most the number of candidates counts for an image.
Then the times for 10,000 images, with random vectors of the same size.
"""

from __future__ import annotations

import argparse
import json
import sqlite3
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.large_sets import run_watched
from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.tasks.rendered_sets import prepare_set
from benchmarks.tasks.sfm import data_root, prepare
from epipole.features import describe_images, most_similar, train_vocabulary
from epipole.io.colmap.database import read_database

STREET, STREET_IMAGES = "street", 1000
KITCHEN = "kitchen-all"
LEAST_INLIERS = 30
CANDIDATES = (5, 10, 20, 50)
MANY = 10_000
RESULTS = REPOSITORY / "benchmarks" / "results" / "retrieval.json"


def main() -> None:
    """Run, print the table and write the results."""
    parser = argparse.ArgumentParser(description="Recall of image retrieval.")
    parser.add_argument("--set", nargs="*", default=[KITCHEN, STREET], choices=[KITCHEN, STREET])
    parser.add_argument("--out", type=Path, required=True, help="folder for images and models")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    sets = [measure(name, arguments.out, arguments.data) for name in arguments.set]
    found = {
        "machine": describe_machine(2),
        "least_inliers": LEAST_INLIERS,
        "sets": sets,
        "many": time_of_many(MANY, 128 * 128),
    }
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")
    table = Table(title="Retrieval")
    for column in ("set", "images", "true neighbors", *(f"recall at {k}" for k in CANDIDATES), "seconds"):
        table.add_column(column)
    for row in sets:
        recall = (f"{100 * row['recall'][k]:.1f} %" for k in CANDIDATES)
        table.add_row(
            row["set"], str(row["images"]), f"{row['neighbors']:.1f}", *recall, f"{row['seconds']:.1f}"
        )
    console = Console(width=120)
    console.print(table)
    console.print(f"{MANY:,} images compared in {found['many']['seconds']:.1f} s")


def measure(name: str, out: Path, data: Path | None) -> dict[str, Any]:
    """Recall and time of a set, whose pairs are matched first."""
    if name == STREET:
        images, options = prepare_set(STREET, STREET_IMAGES, out).images, list[str]()
        work = images.parent  # as in `benchmarks.large_sets`
    else:
        work = out / f"retrieval_{name}"
        work.mkdir(parents=True, exist_ok=True)
        task = prepare(name, data_root(data), work)
        images, options = task.images, ["--pairing.method", "exhaustive"]
        options += ["--camera-params", ",".join(map(repr, task.camera_params or ()))]
    program = str(Path(sys.executable).with_name("epipole"))
    command = [program, "reconstruct", str(images), str(work / "model"), *options]
    if not (work / "model" / "summary.json").is_file():
        run_watched(command, work / "reconstruct.log")
    database = work / "model" / "database.db"
    stored = read_database(database, with_pairs=False)
    descriptors = [
        np.zeros((0, 128), np.uint8) if each is None else each for each in stored.descriptors or ()
    ]
    start = perf_counter()
    ranked = most_similar(describe_images(descriptors, train_vocabulary(descriptors)), max(CANDIDATES))
    seconds = perf_counter() - start
    neighbors = neighbors_in(database, len(descriptors))
    return {
        "set": name,
        "images": len(descriptors),
        "neighbors": float(np.mean([len(each) for each in neighbors])),
        "recall": {k: recall_at(ranked, neighbors, k) for k in CANDIDATES},
        "seconds": seconds,
    }


def neighbors_in(database: Path, num_images: int) -> list[set[int]]:
    """Images, by row, with enough verified matches with each image."""
    with closing(sqlite3.connect(database)) as connection:
        ids = [row[0] for row in connection.execute("SELECT image_id FROM images ORDER BY image_id")]
        query = "SELECT pair_id FROM two_view_geometries WHERE rows >= ?"
        pairs = [row[0] for row in connection.execute(query, (LEAST_INLIERS,))]
    row_of, out = {number: k for k, number in enumerate(ids)}, [set[int]() for _ in range(num_images)]
    for pair in pairs:  # COLMAP: pair_id = 2147483647 image_id1 + image_id2
        first, second = (row_of[number] for number in divmod(pair, 2147483647))
        out[first].add(second)
        out[second].add(first)
    return out


def recall_at(ranked: np.ndarray, neighbors: Sequence[set[int]], count: int) -> float:
    """Part of the true neighbors among the first candidates, over all images."""
    hits = sum(len(true.intersection(row[:count].tolist())) for row, true in zip(ranked, neighbors))
    return hits / max(1, sum(min(len(true), count) for true in neighbors))


def time_of_many(count: int, width: int) -> dict[str, float]:
    """Seconds to compare the vectors of many images with each other."""
    vectors = np.random.default_rng(0).standard_normal((count, width), np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    start = perf_counter()
    most_similar(vectors, max(CANDIDATES))
    return {"images": count, "seconds": perf_counter() - start}


if __name__ == "__main__":
    main()
