"""Verifying a thousand pairs, and the verdicts on rendered ones. `python -m benchmarks.throughput`.

Each program runs in a process of its own, in turn, after a warm-up; the table shows the median of the rounds.
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
from benchmarks.tasks.pairs import KINDS, KnownPair, made_up_pairs, rendered_pairs

MAX_ERROR_PX = 4.0


def verify_with_epipole(problems: list[KnownPair], threads: int) -> list[str]:
    """verify_pairs, with as many threads as asked."""
    from epipole import _parallel
    from epipole.robust import PairKind, PairMatches, RansacConfig, verify_pairs

    _parallel.set_num_threads(threads)
    words = {
        PairKind.GENERAL: "general",
        PairKind.PLANAR: "planar",
        PairKind.ROTATION: "rotation",
        PairKind.NO_MOTION: "rest",
    }
    pairs = [PairMatches(a, b, camera, camera, seed=k) for k, (a, b, _, camera) in enumerate(problems)]
    found = verify_pairs(
        pairs, RansacConfig(max_error_px=MAX_ERROR_PX, confidence=0.999, min_inlier_ratio=0.25)
    )
    return [words.get(g.kind, "none") for g in found]


def verify_with_pycolmap(problems: list[KnownPair], _threads: int) -> list[str]:
    """E, F and H with its own selection at its own settings. It has no word for a camera at rest."""
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error = MAX_ERROR_PX
    options.compute_relative_pose = True  # without it a plane and a rotation are one
    options.ransac.random_seed = 0
    words = {2: "general", 3: "general", 4: "planar", 5: "rotation", 6: "planar"}
    out = []
    for a, b, _, known in problems:
        params = [*known.params[:2], *(known.params[2:] + 0.5)]  # its image's corner is at (0, 0)
        camera = pycolmap.Camera(model="PINHOLE", width=known.width, height=known.height, params=params)
        rows = np.repeat(np.arange(len(a), dtype=np.uint32)[:, None], 2, axis=1)
        found = pycolmap.estimate_calibrated_two_view_geometry(
            camera, a + 0.5, camera, b + 0.5, rows, options
        )
        out.append(words.get(int(found.config), "none"))
    return out


def verify_with_poselib(problems: list[KnownPair], _threads: int) -> list[str]:
    """Relative pose alone: it says nothing of the kind."""
    import poselib

    options = {
        "max_epipolar_error": MAX_ERROR_PX,
        "min_iterations": 100,
        "max_iterations": 10_000,
        "success_prob": 0.999,
    }
    for a, b, _, known in problems:
        size = {"width": known.width, "height": known.height}
        camera = {"model": "PINHOLE", **size, "params": list(known.params)}
        poselib.estimate_relative_pose(a, b, camera, camera, options, {})
    return ["none"] * len(problems)


def main() -> None:
    """Run both comparisons and print their tables."""
    parser = argparse.ArgumentParser(description="Verification of many pairs at once.")
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
        ("verify", made_up_pairs(arguments.pairs, arguments.matches, arguments.outliers), arguments.rounds),
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
    """Share of right words; a camera at rest may be called a rotation, which by nothing it is."""
    out = {}
    for kind in KINDS:
        pairs = [(f, t) for f, t in zip(found, truth) if t == kind]
        out[kind] = float(np.mean([f == t or (t == "rest" and f == "rotation") for f, t in pairs]))
    return out | {"all": float(np.mean(list(out.values())))}


if __name__ == "__main__":
    main()
