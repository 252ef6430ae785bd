"""Structure from motion of few, distant images: `python -m benchmarks.learned_rescue FOLDER_WITH_WEIGHTS`.

SIFT, SIFT averaged over five window sizes (domain-size pooling), and SIFT with the rescue by learned features.
Sets: every nth image of fountain-P11 and of the temple ring, a rendered courtyard seen from an arc of 100 degrees, and the video of a room with
bare walls, which has no truth. An image is right if it is in the largest model and at most 1 % of the scene's size off; the models are
aligned with the truth.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

import epipole
from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.score import cams_in_order, largest_model
from benchmarks.tasks.sfm import data_root, prepare
from epipole.cameras import Camera, CameraModel
from epipole.config import FeatureConfig
from epipole.errors import DegenerateGeometryError, NoModelError
from epipole.geometry import Rigid3
from epipole.io.truth import read_truth
from epipole.metrics import camera_errors
from epipole.synthetic import courtyard, courtyard_views, render

RIGHT_PERCENT = 1.0
THREADS = 2
WAYS = ("SIFT", "SIFT, 5 window sizes", "SIFT and xfeat", "SIFT and aliked")


@dataclass(frozen=True, slots=True, eq=False)
class SparseSet:
    """Few images of a scene, and their true poses if they are known."""

    name: str
    images: Path
    names: tuple[str, ...]
    camera_params: str | None
    truth: Rigid3 | None


def main() -> None:
    """Run each set in all four ways; ALIKED takes a quarter of an hour for the room, and is left out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("weights", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="epipole-bench-") as scratch:
        work = Path(scratch)
        everything = sets(data_root(arguments.data), work)
        run(everything[0], WAYS[1], arguments.weights, work)  # compiles kernels
        for each in everything:
            for way in WAYS[: 4 if each.truth is not None else 3]:
                rows.append(run(each, way, arguments.weights, work))
                print(rows[-1], file=sys.stderr)
    Console(width=140).print(table(rows))
    report = {"machine": describe_machine(THREADS), "runs": rows}
    (arguments.results / "learned_rescue.json").write_text(json.dumps(report, indent=1) + "\n")


def sets(data: Path, work: Path) -> list[SparseSet]:
    """All sets, their images in folders under `work`."""
    out = [_every(data, work, "fountain-P11", n) for n in (3, 4)]
    out += [_every(data, work, "temple_ring", n) for n in (4, 6)]
    out += [_courtyard(work, n) for n in (5, 4)]
    room = data / "sfm" / "phone_room"
    names = tuple(sorted(p.name for p in room.glob("*.jpg")))
    return [*out, SparseSet("phone_room", room, names, None, None)]


def _every(data: Path, work: Path, name: str, step: int) -> SparseSet:
    task = prepare(name, data, work)
    folder = work / f"{name}-{step}"
    folder.mkdir()
    names = task.image_names[::step]
    for image in names:
        shutil.copy(task.images / image, folder / image)
    assert task.truth is not None and task.camera_params is not None
    truth = read_truth(task.truth)
    poses = truth.cams_from_world[[list(truth.names).index(image) for image in names]]
    return SparseSet(
        f"{name}, one image in {step}", folder, names, ",".join(map(repr, task.camera_params)), poses
    )


def _courtyard(work: Path, count: int) -> SparseSet:
    camera = Camera(CameraModel.PINHOLE, 800, 600, np.array([700.0, 700.0, 399.5, 299.5]))
    poses, folder = courtyard_views(count), work / f"courtyard-{count}"
    folder.mkdir()
    names = tuple(f"{k}.png" for k in range(count))
    for k, name in enumerate(names):
        rgb = render(courtyard(), camera, poses[k], noise_sigma=2.0, seed=k).rgb
        cv2.imwrite(str(folder / name), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    return SparseSet(f"courtyard, {count} images", folder, names, "700,700,400,300", poses)


def run(each: SparseSet, way: str, weights: Path, work: Path) -> dict[str, Any]:
    """Images in the largest model, images of it that are right, and seconds."""
    out = work / "out"
    shutil.rmtree(out, ignore_errors=True)
    known = (
        {} if each.camera_params is None else {"camera_model": "PINHOLE", "camera_params": each.camera_params}
    )
    more: dict[str, Any] = {}
    if way == WAYS[1]:
        more = {"features": FeatureConfig(domain_sizes=5)}
    elif way in WAYS[2:]:
        more = {"learned": weights, "learned_network": way.split()[-1]}
    start = time.perf_counter()
    with contextlib.suppress(NoModelError):
        epipole.reconstruct(each.images, out, **known, **more)
    seconds = time.perf_counter() - start
    model = largest_model(out / "sparse")[0] if (out / "sparse").is_dir() else None
    num_registered = 0 if model is None else int(model.is_registered().sum())
    right = None
    if each.truth is not None:
        right = 0
        size = np.linalg.norm(np.ptp(each.truth.centers(), axis=0))
        if model is not None:
            with contextlib.suppress(DegenerateGeometryError):
                errors = camera_errors(cams_in_order(model, each.names), each.truth)
                right = int((errors.position < 0.01 * RIGHT_PERCENT * size).sum())
    return {
        "set": each.name,
        "features": way,
        "images": len(each.names),
        "registered": num_registered,
        "right": right,
        "seconds": round(seconds, 1),
    }


def table(rows: list[dict[str, Any]]) -> Table:
    """The results for people."""
    out = Table(title="few, distant images")
    for heading in ("set", "features", "registered", "right", "seconds"):
        out.add_column(heading, justify="left" if heading in ("set", "features") else "right")
    for row in rows:
        right = "-" if row["right"] is None else str(row["right"])
        out.add_row(
            row["set"],
            row["features"],
            f"{row['registered']} of {row['images']}",
            right,
            f"{row['seconds']:.1f}",
        )
    return out


if __name__ == "__main__":
    main()
