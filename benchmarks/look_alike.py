"""Structure from motion where different surfaces look the same: `python -m benchmarks.look_alike --scene city tiled --seeds 3`.

Renders each scene to a temporary folder, runs the programs with known intrinsics, and compares pairs and models with the exact truth.
The columns are explained in benchmarks/README.md. Results go to benchmarks/results/look_alike.json, with the false
pairs that share the most points in a model.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.look_alike_score import (
    ModelScore,
    PairScore,
    score_model,
    score_pairs,
    shared_points,
    verdict,
)
from benchmarks.measure import REPOSITORY, describe_machine, run_measured
from benchmarks.peers.base import Limits, SfmPeer
from benchmarks.peers.epipole_sfm import EpipoleSfm
from benchmarks.peers.pycolmap_sfm import PycolmapSfm
from benchmarks.tasks.look_alike import SCENES, RenderedTask, prepare_rendered
from epipole.io.colmap.model import read_colmap_model
from epipole.scene import Reconstruction

NUM_THREADS = 1
NUM_LISTED = 20
"""False pairs listed in the results for each run: those with the most shared points in a model."""


def main() -> None:
    """Run the programs on the chosen scenes and print a table."""
    arguments = _arguments()
    console = Console(width=max(200, Console().width))
    options = tuple(f"--{option}" for option in arguments.option)
    peers: list[SfmPeer] = [EpipoleSfm(), PycolmapSfm("incremental")]
    rows: list[dict[str, Any]] = []
    for name in arguments.scene:
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
            with tempfile.TemporaryDirectory(prefix="epipole-bench-") as scratch:
                kept = None if arguments.keep is None else arguments.keep / f"{name}{seed}"
                if kept is not None and kept.exists():
                    raise FileExistsError(f"{kept} exists: remove it, or pass another folder with --keep.")
                scene = prepare_rendered(name, seed, Path(scratch))
                for peer in peers:
                    if peer.version() is None:
                        continue
                    added = options if peer.name == "epipole" else ()
                    if arguments.neighbors is not None and peer.name == "epipole":
                        pairs = _write_neighbors(scene, arguments.neighbors, Path(scratch))
                        added = (*added, "--pairs", str(pairs))
                    rows.append(_run(scene, peer, Path(scratch), added))
                    console.print(
                        f"{name}{seed}, {peer.name}: {rows[-1]['verdict']}, {rows[-1]['wall_s']:.0f} s"
                    )
                if kept is not None:
                    shutil.copytree(scratch, kept)
    console.print(_table(rows))
    if not options and arguments.neighbors is None:
        report = {"machine": describe_machine(NUM_THREADS), "runs": rows}
        without_nan = json.loads(json.dumps(report), parse_constant=lambda _: None)
        (arguments.results / "look_alike.json").write_text(json.dumps(without_nan, indent=1) + "\n")


def _run(scene: RenderedTask, peer: SfmPeer, work: Path, options: tuple[str, ...]) -> dict[str, Any]:
    """Run one program on one scene and score its pairs and models."""
    out = work / peer.name
    command = [*peer.command(scene.task, out, Limits(num_threads=NUM_THREADS)), *options]
    measure = run_measured(command, work / f"{peer.name}.log", NUM_THREADS)
    models = [read_colmap_model(p) for p in sorted((out / "sparse").glob("*"))]
    pairs = score_pairs(scene, out) if (out / "database.db").is_file() else []
    scores = [score_model(scene, model) for model in models]
    false_pairs = [
        asdict(pair) | {"points_in_models": _points_in(models, pair)} for pair in pairs if pair.is_false
    ]
    false_pairs.sort(key=lambda pair: -pair["points_in_models"])
    return {
        "scene": scene.task.name,
        "program": peer.name,
        "verdict": verdict(scores),
        "images": len(scene.task.image_names),
        "size_m": scene.size_m,
        "wall_s": measure.wall_s,
        "models": [asdict(score) for score in scores],
        "pairs": len(pairs),
        "true_lost": sum(not (pair.is_false or pair.is_kept) for pair in pairs),
        **count_false(false_pairs),
        "worst_false_pairs": false_pairs[:NUM_LISTED],
    }


def count_false(false_pairs: list[dict[str, Any]]) -> dict[str, int]:
    """Number of false pairs, of each reason, of those that mapping uses, and of those whose images share points of a model."""
    return {
        "false": len(false_pairs),
        "no_overlap": sum(pair["has_no_overlap"] for pair in false_pairs),
        "wrong_rotation": sum(pair["has_wrong_rotation"] for pair in false_pairs),
        "wrong_matches": sum(pair["has_wrong_matches"] for pair in false_pairs),
        "false_kept": sum(pair["is_kept"] for pair in false_pairs),
        "false_in_models": sum(pair["points_in_models"] >= PairScore.MIN_MATCHES for pair in false_pairs),
    }


def _points_in(models: list[Reconstruction], pair: PairScore) -> int:
    return sum(shared_points(model, pair) for model in models)


def _write_neighbors(scene: RenderedTask, most: int, work: Path) -> Path:
    """A list of the pairs of images that are at most `most` images apart on the walk, which is closed."""
    names, file = scene.task.image_names, work / "neighbors.txt"
    pairs = [
        f"{names[i]} {names[j]}"
        for i, j in combinations(range(len(names)), 2)
        if min(j - i, len(names) - j + i) <= most
    ]
    file.write_text("\n".join(pairs) + "\n")
    return file


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="look-alike scenes, known intrinsics")
    for heading in ("scene", "program", "images", "pairs", "false", "no overlap", "rotation", "matches"):
        table.add_column(heading, justify="left" if heading in ("scene", "program") else "right")
    for heading in ("kept", "in models", "true lost", "median m", "max m", "median %", "max %", "rot. deg"):
        table.add_column(heading, justify="right")
    table.add_column("verdict")
    for row in rows:
        models = [ModelScore(**score) for score in row["models"]]
        registered = " + ".join(str(m.num_registered) for m in models) or "0"
        table.add_row(
            row["scene"],
            row["program"],
            f"{registered} of {row['images']}",
            *(str(row[name]) for name in _COUNTS),
            *("\n".join(format(getattr(m, column), ".3f") for m in models) for column in _LENGTHS),
            *("\n".join(format(getattr(m, column), ".2f") for m in models) for column in _PERCENT),
            "\n".join(f"{m.rotation_median_deg:.2f}" for m in models),
            row["verdict"],
        )
    return table


_COUNTS = (
    *("pairs", "false", "no_overlap", "wrong_rotation", "wrong_matches"),
    *("false_kept", "false_in_models", "true_lost"),
)
_LENGTHS = ("position_median_m", "position_max_m")
_PERCENT = ("position_median_percent", "position_max_percent")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds of each scene")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="copy images and output folders here")
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    parser.add_argument(
        "--neighbors", type=int, help="epipole gets only pairs at most this far apart on the walk"
    )
    parser.add_argument("--option", nargs="+", default=[], help="options of epipole reconstruct, without --")
    return parser.parse_args()


if __name__ == "__main__":
    main()
