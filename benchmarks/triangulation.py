"""Triangulation of a million points from two views, and of points with outliers from five. `python -m benchmarks.triangulation`.

Each program runs in its own process, in turn, after a warm-up; the table has medians of the rounds.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.side_by_side import compare, table_of
from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3

NOISE_PX = 1.0
MAX_ERROR_PX = 4.0
"""Inlier threshold of the robust estimators."""
OUTLIERS = 0.1
"""Fraction of outlier pixels in the five-view problem."""
NUM_LOOPED = 20_000
"""Points that pycolmap triangulates one by one."""
CAMERA = Camera(CameraModel.PINHOLE, 1280, 960, np.array([800.0, 800.0, 639.5, 479.5]))
VIEWS = Rigid3.exp(
    np.array(
        [
            *([0, 0, 0, 0, 0, 0], [-1, 0.1, 0.05, 0.02, 0.1, 0.0], [1, 0.1, 0.0, 0.0, -0.1, 0.02]),
            *([0.1, -0.8, 0.1, -0.1, 0.0, 0.0], [0.2, 0.9, -0.1, 0.1, 0.02, 0.0]),
        ]
    )
)


def synthetic_views(num_views: int, count: int, outliers: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (v, n, 2) of points in the first views, with a fraction of outliers, and the points (n, 3)."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (count, 3))
    pixels = np.stack([CAMERA.project(VIEWS[k].apply(points)) for k in range(num_views)])
    pixels += NOISE_PX * rng.standard_normal(pixels.shape)
    is_outlier = rng.random((num_views, count)) < outliers
    pixels[is_outlier] = rng.uniform(0, (1280, 960), (int(is_outlier.sum()), 2))
    return pixels, points


def triangulate_with_epipole(pixels: np.ndarray, threads: int) -> np.ndarray:
    """Triangulate with `epipole.robust.triangulate_points`."""
    from epipole import _parallel
    from epipole.robust import triangulate_points

    _parallel.set_num_threads(threads)
    return triangulate_points(VIEWS[: len(pixels)], CAMERA, pixels).points_in_world


def triangulate_with_opencv(pixels: np.ndarray, threads: int) -> np.ndarray:
    """Triangulate with `cv2.triangulatePoints`."""
    import cv2

    cv2.setNumThreads(threads)
    one, two = (CAMERA.K @ VIEWS[k].as_matrix()[:3] for k in range(2))
    found = cv2.triangulatePoints(
        one, two, np.ascontiguousarray(pixels[0].T), np.ascontiguousarray(pixels[1].T)
    )
    return (found[:3] / found[3]).T


def triangulate_with_pycolmap(pixels: np.ndarray, _threads: int) -> np.ndarray:
    """Triangulate the first points one by one with `pycolmap.triangulate_point`, which has no batched variant."""
    import pycolmap

    one, two = (VIEWS[k].as_matrix()[:3] for k in range(2))
    a, b = ((p[:NUM_LOOPED] - CAMERA.K[:2, 2]) / 800.0 for p in pixels)
    found = [pycolmap.triangulate_point(one, two, u, v) for u, v in zip(a, b)]
    return np.array([np.full(3, np.nan) if x is None else np.ravel(x) for x in found])


def robustly_with_epipole(pixels: np.ndarray, threads: int) -> np.ndarray:
    """Triangulate robustly with `epipole.robust.triangulate_points`."""
    from epipole import _parallel
    from epipole.robust import triangulate_points

    _parallel.set_num_threads(threads)
    found = triangulate_points(VIEWS[: len(pixels)], CAMERA, pixels, max_error_px=MAX_ERROR_PX)
    return found.points_in_world


def robustly_with_pycolmap(pixels: np.ndarray, _threads: int) -> np.ndarray:
    """Triangulate robustly with `pycolmap.estimate_triangulation`, point by point, with the same threshold."""
    import pycolmap

    params = [*CAMERA.params[:2], *(CAMERA.params[2:] + 0.5)]
    camera = pycolmap.Camera(model="PINHOLE", width=1280, height=960, params=params)
    options = pycolmap.EstimateTriangulationOptions()
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.ransac.max_error = MAX_ERROR_PX
    options.ransac.random_seed = 0
    views = [pycolmap.Rigid3d(VIEWS[k].as_matrix()[:3]) for k in range(len(pixels))]
    out = np.full((pixels.shape[1], 3), np.nan)
    for n, seen in enumerate(np.swapaxes(pixels, 0, 1) + 0.5):
        found = pycolmap.estimate_triangulation(seen, views, [camera] * len(views), options)
        if found is not None:
            out[n] = np.ravel(found["xyz"])
    return out


def main() -> None:
    """Run both comparisons, print their tables and write the results."""
    parser = argparse.ArgumentParser(description="Triangulation of many points.")
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    report: dict[str, Any] = {"machine": describe_machine(2)}
    two_views: dict[str, tuple[Callable[..., Any], int]] = {
        "epipole, 2 threads": (triangulate_with_epipole, 2),
        "epipole, 1 thread": (triangulate_with_epipole, 1),
        "OpenCV, 1 thread": (triangulate_with_opencv, 1),
        "OpenCV, 2 threads": (triangulate_with_opencv, 2),
        f"pycolmap, {NUM_LOOPED} points": (triangulate_with_pycolmap, 1),
    }
    five_views: dict[str, tuple[Callable[..., Any], int]] = {
        "epipole, 2 threads": (robustly_with_epipole, 2),
        "epipole, 1 thread": (robustly_with_epipole, 1),
        "pycolmap": (robustly_with_pycolmap, 1),
    }
    for name, programs, data in (
        ("two views", two_views, synthetic_views(2, arguments.points, 0.0)),
        ("five views, a tenth of the pixels wrong", five_views, synthetic_views(5, NUM_LOOPED, OUTLIERS)),
    ):
        pixels, points = data
        report[name] = compare(
            programs, pixels, arguments.rounds, lambda f, points=points: _errors(f, points)
        )
        Console().print(table_of(name, report[name]))
    arguments.results.mkdir(parents=True, exist_ok=True)
    (arguments.results / "triangulation.json").write_text(json.dumps(report, indent=1) + "\n")


def _errors(found: np.ndarray, points: np.ndarray) -> dict[str, float]:
    distances = np.linalg.norm(found - points[: len(found)], axis=1)
    known = distances[np.isfinite(distances)]
    return {
        "mean error": float(known.mean()),
        "median error": float(np.median(known)),
        "90 % error": float(np.quantile(known, 0.9)),
        "found": len(known) / len(distances),
    }


if __name__ == "__main__":
    main()
