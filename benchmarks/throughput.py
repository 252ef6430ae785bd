"""Geometric verification of many image pairs: time, and fraction classified correctly. `python -m benchmarks.throughput`.

Each program runs in its own process, in turn, after a warm-up; the table has medians of the rounds.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.side_by_side import compare, table_of
from benchmarks.tasks.pairs import KINDS, KnownPair, rendered_pairs, synthetic_pairs

MAX_ERROR_PX = 4.0


def verify_with_epipole(problems: list[KnownPair], threads: int) -> list[str]:
    """Kinds of the pairs by epipole's `verify_pairs`."""
    from epipole import _parallel
    from epipole.robust import PairKind, PairMatches, RansacConfig, verify_pairs

    _parallel.set_num_threads(threads)
    names = {
        PairKind.GENERAL: "general",
        PairKind.PLANAR: "planar",
        PairKind.ROTATION: "rotation",
        PairKind.NO_MOTION: "rest",
    }
    pairs = [PairMatches(a, b, camera, camera, seed=k) for k, (a, b, _, camera) in enumerate(problems)]
    found = verify_pairs(
        pairs, RansacConfig(max_error_px=MAX_ERROR_PX, confidence=0.999, min_inlier_ratio=0.25)
    )
    return [names.get(g.kind, "none") for g in found]


def verify_with_pycolmap(problems: list[KnownPair], _threads: int) -> list[str]:
    """Kinds of the pairs by pycolmap's two-view geometry with default options, which has no kind for a static camera."""
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error = MAX_ERROR_PX
    options.compute_relative_pose = True  # needed to distinguish planes from rotations
    options.ransac.random_seed = 0
    names = {2: "general", 3: "general", 4: "planar", 5: "rotation", 6: "planar"}
    out = []
    for a, b, _, ours in problems:
        params = [*ours.params[:2], *(ours.params[2:] + 0.5)]  # COLMAP's image corner is (0, 0)
        camera = pycolmap.Camera(model="PINHOLE", width=ours.width, height=ours.height, params=params)
        rows = np.repeat(np.arange(len(a), dtype=np.uint32)[:, None], 2, axis=1)
        found = pycolmap.estimate_calibrated_two_view_geometry(
            camera, a + 0.5, camera, b + 0.5, rows, options
        )
        out.append(names.get(int(found.config), "none"))
    return out


def verify_with_poselib(problems: list[KnownPair], _threads: int) -> list[str]:
    """Relative poses by PoseLib, which does not determine the kind."""
    import poselib

    options = {
        "max_epipolar_error": MAX_ERROR_PX,
        "min_iterations": 100,
        "max_iterations": 10_000,
        "success_prob": 0.999,
    }
    for a, b, _, ours in problems:
        size = {"width": ours.width, "height": ours.height}
        camera = {"model": "PINHOLE", **size, "params": list(ours.params)}
        poselib.estimate_relative_pose(a, b, camera, camera, options, {})
    return ["none"] * len(problems)


def main() -> None:
    """Run both comparisons, print their tables and write the results."""
    parser = argparse.ArgumentParser(description="Geometric verification of many image pairs.")
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--matches", type=int, default=1000)
    parser.add_argument("--outliers", type=float, default=0.4)
    parser.add_argument("--rendered", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    programs = {
        "epipole, 2 threads": (verify_with_epipole, 2),
        "epipole, 1 thread": (verify_with_epipole, 1),
        "pycolmap": (verify_with_pycolmap, 1),
        "PoseLib (pose alone)": (verify_with_poselib, 1),
    }
    report: dict[str, Any] = {"machine": describe_machine(2)}
    for name, problems, rounds in (
        ("verify", synthetic_pairs(arguments.pairs, arguments.matches, arguments.outliers), arguments.rounds),
        ("verify rendered", rendered_pairs(arguments.rendered), 1),
    ):
        truth = [pair.kind for pair in problems]
        report[name] = compare(
            programs, problems, rounds, lambda found, truth=truth: _agreement(found, truth)
        )
        Console().print(table_of(name, report[name]))
    arguments.results.mkdir(parents=True, exist_ok=True)
    (arguments.results / "throughput.json").write_text(json.dumps(report, indent=1) + "\n")


def _agreement(found: list[str], truth: list[str]) -> dict[str, float]:
    """Fraction of correct kinds; for a static camera, "rotation" (by zero degrees) is correct, too."""
    out = {}
    for kind in KINDS:
        pairs = [(f, t) for f, t in zip(found, truth) if t == kind]
        out[kind] = float(np.mean([f == t or (t == "rest" and f == "rotation") for f, t in pairs]))
    return out | {"all": float(np.mean(list(out.values())))}


if __name__ == "__main__":
    main()
