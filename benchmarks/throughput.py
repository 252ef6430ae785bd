"""Many at once: verifying a thousand pairs, triangulating a million points. `python -m benchmarks.throughput`.

Each program runs in a process of its own, in turn, after a warm-up; the table shows the median of the rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.synthetic.problems import two_view_problem

KINDS = ("general", "planar", "rotation", "rest")
MAX_ERROR_PX, NOISE_PX = 4.0, 1.0
LOOPED = 20_000
CAMERA = Camera(CameraModel.PINHOLE, 1280, 960, np.array([800.0, 800.0, 639.5, 479.5]))
VIEWS = Rigid3.exp(np.array([[0, 0, 0, 0, 0, 0], [-1, 0.1, 0.05, 0.02, 0.1, 0.0]]))

Problem = tuple[np.ndarray, np.ndarray, str]


def made_up_pairs(count: int, num_matches: int, outliers: float) -> list[Problem]:
    """Matches of general, planar and rotating pairs, and of a camera at rest, with one pixel of noise."""
    out = []
    for seed in range(count):
        name = KINDS[seed % 4]
        p = two_view_problem(
            num_matches, outliers, NOISE_PX, seed, kind="general" if name == "rest" else name
        )
        second = p.pixels2
        if name == "rest":
            noise = NOISE_PX * np.random.default_rng(seed).standard_normal(second.shape)
            second = np.where(p.inlier_mask[:, None], p.pixels1 + noise, second)
        out.append((p.pixels1, second, name))
    return out


def verify_with_epipole(problems: list[Problem], threads: int) -> list[str]:
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
    pairs = [PairMatches(a, b, CAMERA, CAMERA, seed=k) for k, (a, b, _) in enumerate(problems)]
    found = verify_pairs(
        pairs, RansacConfig(max_error_px=MAX_ERROR_PX, confidence=0.999, min_inlier_ratio=0.25)
    )
    return [words.get(g.kind, "none") for g in found]


def verify_with_pycolmap(problems: list[Problem], _threads: int) -> list[str]:
    """E, F and H with its own selection at its own settings. It has no word for a camera at rest."""
    import pycolmap

    camera = pycolmap.Camera(model="PINHOLE", width=1280, height=960, params=[800.0, 800.0, 640.0, 480.0])
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error = MAX_ERROR_PX
    options.compute_relative_pose = True  # without it a plane and a rotation are one
    options.ransac.random_seed = 0
    words = {2: "general", 3: "general", 4: "planar", 5: "rotation", 6: "planar"}
    out = []
    for a, b, _ in problems:
        rows = np.repeat(np.arange(len(a), dtype=np.uint32)[:, None], 2, axis=1)
        found = pycolmap.estimate_calibrated_two_view_geometry(
            camera, a + 0.5, camera, b + 0.5, rows, options
        )
        out.append(words.get(int(found.config), "none"))
    return out


def verify_with_poselib(problems: list[Problem], _threads: int) -> list[str]:
    """Relative pose alone: it says nothing of the kind."""
    import poselib

    camera = {"model": "PINHOLE", "width": 1280, "height": 960, "params": [800.0, 800.0, 639.5, 479.5]}
    options = {
        "max_epipolar_error": MAX_ERROR_PX,
        "min_iterations": 100,
        "max_iterations": 10_000,
        "success_prob": 0.999,
    }
    for a, b, _ in problems:
        poselib.estimate_relative_pose(a, b, camera, camera, options, {})
    return ["none"] * len(problems)


def made_up_views(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (2, n, 2) of points in two views, and the points."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (count, 3))
    pixels = np.stack([CAMERA.project(VIEWS[k].apply(points)) for k in range(2)])
    return pixels + NOISE_PX * rng.standard_normal(pixels.shape), points


def triangulate_with_epipole(pixels: np.ndarray, threads: int) -> np.ndarray:
    """triangulate_points."""
    from epipole import _parallel
    from epipole.robust import triangulate_points

    _parallel.set_num_threads(threads)
    return triangulate_points(VIEWS, CAMERA, pixels).points_in_world


def triangulate_with_opencv(pixels: np.ndarray, threads: int) -> np.ndarray:
    """cv2.triangulatePoints."""
    import cv2

    cv2.setNumThreads(threads)
    one, two = (CAMERA.K @ VIEWS[k].as_matrix()[:3] for k in range(2))
    found = cv2.triangulatePoints(
        one, two, np.ascontiguousarray(pixels[0].T), np.ascontiguousarray(pixels[1].T)
    )
    return (found[:3] / found[3]).T


def triangulate_with_pycolmap(pixels: np.ndarray, _threads: int) -> np.ndarray:
    """pycolmap.triangulate_point in a loop over the first points: it has no call for many."""
    import pycolmap

    one, two = (VIEWS[k].as_matrix()[:3] for k in range(2))
    a, b = ((p[:LOOPED] - CAMERA.K[:2, 2]) / 800.0 for p in pixels)
    found = [pycolmap.triangulate_point(one, two, u, v) for u, v in zip(a, b)]
    return np.array([np.full(3, np.nan) if x is None else np.ravel(x) for x in found])


def _timed(run: Callable[..., Any], data: Any, threads: int, connection: Any) -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        warm = data[:8] if isinstance(data, list) else data[:, :100]
        run(warm, threads)
        start = time.perf_counter()
        out = run(data, threads)
        connection.send((time.perf_counter() - start, out))
    except (ImportError, AttributeError, TypeError) as error:
        connection.send((float("nan"), repr(error)))


def in_own_process(run: Callable[..., Any], data: Any, threads: int) -> tuple[float, Any]:
    """(seconds, result) of one run after a warm-up; NaN and the words of the error if the program is not there."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_timed, args=(run, data, threads, theirs))
    process.start()
    out = ours.recv()
    process.join()
    return out


def main() -> None:
    """Run both comparisons and print their tables."""
    parser = argparse.ArgumentParser(description="Verification and triangulation of many at once.")
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--matches", type=int, default=1000)
    parser.add_argument("--outliers", type=float, default=0.4)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    report: dict[str, Any] = {"machine": describe_machine(2)}
    problems = made_up_pairs(arguments.pairs, arguments.matches, arguments.outliers)
    truth = [name for _, _, name in problems]
    programs = {
        "epipole, 2 threads": (verify_with_epipole, 2),
        "epipole, 1 thread": (verify_with_epipole, 1),
        "pycolmap": (verify_with_pycolmap, 1),
        "PoseLib (pose alone)": (verify_with_poselib, 1),
    }
    report["verify"] = _compare(programs, problems, arguments.rounds, lambda found: _agreement(found, truth))
    pixels, points = made_up_views(arguments.points)
    programs = {
        "epipole, 2 threads": (triangulate_with_epipole, 2),
        "epipole, 1 thread": (triangulate_with_epipole, 1),
        "OpenCV, 1 thread": (triangulate_with_opencv, 1),
        "OpenCV, 2 threads": (triangulate_with_opencv, 2),
        f"pycolmap, {LOOPED} points": (triangulate_with_pycolmap, 1),
    }

    def error(found: np.ndarray) -> dict[str, float]:
        apart = np.linalg.norm(found - points[: len(found)], axis=1)
        return {"mean error": float(np.nanmean(apart)), "median error": float(np.nanmedian(apart))}

    report["triangulate"] = _compare(programs, pixels, arguments.rounds, error)
    arguments.results.mkdir(parents=True, exist_ok=True)
    (arguments.results / "throughput.json").write_text(json.dumps(report, indent=1) + "\n")
    for name in ("verify", "triangulate"):
        Console().print(_table(name, report[name]))


def _agreement(found: list[str], truth: list[str]) -> dict[str, float]:
    """Share of right words; a camera at rest may be called a rotation, which by nothing it is."""
    out = {}
    for kind in KINDS:
        pairs = [(f, t) for f, t in zip(found, truth) if t == kind]
        out[kind] = float(np.mean([f == t or (t == "rest" and f == "rotation") for f, t in pairs]))
    return out | {"all": float(np.mean(list(out.values())))}


def _compare(
    programs: dict[str, tuple[Callable[..., Any], int]],
    data: Any,
    rounds: int,
    judge: Callable[[Any], dict[str, float]],
) -> dict[str, Any]:
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    out: dict[str, Any] = {}
    for _ in range(rounds):
        for name, (run, threads) in programs.items():
            took, found = in_own_process(run, data, threads)
            seconds[name].append(took)
            out[name] = {"error": found} if isinstance(found, str) else judge(found)
    for name, figures in out.items():
        figures["seconds"] = statistics.median(seconds[name])
    return out


def _table(name: str, rows: dict[str, Any]) -> Table:
    table = Table(title=name)
    columns = list(dict.fromkeys(key for row in rows.values() for key in row))
    for column in ("program", *columns):
        table.add_column(column, justify="right")
    for program, row in rows.items():
        cells = [row.get(c, "") for c in columns]
        table.add_row(program, *(f"{c:.4g}" if isinstance(c, float) else str(c)[:40] for c in cells))
    return table


if __name__ == "__main__":
    main()
