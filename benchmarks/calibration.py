"""Calibration of real cameras compared with OpenCV's, from the same corners. `python -m benchmarks.calibration`."""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.side_by_side import table_of
from epipole.cameras import Camera, CameraModel
from epipole.config import BoardConfig
from epipole.features.boards import BoardView, corners_on_board, find_board
from epipole.io.images.photographs import read_gray
from epipole.pipelines.calibration.calibrate import calibrate_views
from epipole.pipelines.calibration.comparison import projection_difference
from epipole.pipelines.calibration.config import CalibrationConfig
from epipole.pipelines.calibration.coverage import covered_pixels

PAIR = BoardConfig(columns=9, rows=6, square=0.025)
DESK = BoardConfig(columns=9, rows=6, square=0.04)
SIZE, DESK_SIZE = (640, 480), (752, 480)
SPOILED = (2, 5, 8)
"""Views that `spoiled` replaces."""


def opencv_pair(connection: Any, pixels: list[list[np.ndarray]]) -> None:
    """Calibrate with OpenCV: each camera alone, then the pair, with k1, k2, p1 and p2."""
    import cv2

    board = corners_on_board(PAIR).astype(np.float32)
    boards = [board] * len(pixels[0])
    start = time.perf_counter()
    flags = cv2.CALIB_FIX_K3
    left, right = (cv2.calibrateCamera(boards, corners, SIZE, None, None, flags=flags) for corners in pixels)
    found = cv2.stereoCalibrate(
        *(boards, pixels[0], pixels[1], left[1], left[2], right[1], right[2], SIZE),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(3, 200, 1e-9),
    )
    connection.send(
        {
            "rms px": found[0],
            "left fx": found[1][0, 0],
            "right fx": found[3][0, 0],
            "baseline mm": 1000.0 * float(np.linalg.norm(found[6])),
            "seconds": time.perf_counter() - start,
        }
    )


def our_pair(views: list[list[BoardView]], config: CalibrationConfig) -> dict[str, float]:
    """Calibrate with epipole: the figures of `opencv_pair`, and standard deviations."""
    start = time.perf_counter()
    found = calibrate_views(views, [SIZE] * 2, config)
    seconds = time.perf_counter() - start
    return {
        "rms px": found.rms_px,
        "corners used": float(found.used_mask.sum()),
        "left fx": found.cameras[0].params[0],
        "its sigma": found.params_sigma(0)[0],
        "right fx": found.cameras[1].params[0],
        "sigma": found.params_sigma(1)[0],
        "baseline mm": 1000.0 * found.rig().baseline,
        "sigma mm": 1000.0 * found.baseline_sigma(),
        "seconds": seconds,
    }


def spoiled(views: list[list[BoardView]]) -> list[list[BoardView]]:
    """Ten views, three of them wrong: corners in reverse order, a later image of the right camera, 5 px of noise."""
    out = [list(of_camera[:10]) for of_camera in views]
    first, second, third = SPOILED
    out[0][first] = replace(out[0][first], pixels=out[0][first].pixels[::-1].copy())
    out[1][second] = out[1][second + 1]
    noise = np.random.default_rng(0).normal(0, 5, out[1][third].pixels.shape)
    out[1][third] = replace(out[1][third], pixels=out[1][third].pixels + noise)
    return out


def desk_rows(folder: Path) -> dict[str, dict[str, float]]:
    """Projection differences from the given intrinsics, over the whole image and where corners were observed."""
    views = [find_board(read_gray(path), DESK) for path in sorted((folder / "images").iterdir())]
    K, (k1, k2) = np.loadtxt(folder / "K.txt"), np.loadtxt(folder / "D.txt")
    f = K[0, 0]
    params = np.array([f, K[1, 1], K[0, 2], K[1, 2], k1 * f**2, k2 * f**4, 0.0, 0.0])
    given = Camera(CameraModel.OPENCV, *DESK_SIZE, params)
    rows = {}
    for model in ("RADIAL", "OPENCV"):
        found = calibrate_views([views], [DESK_SIZE], CalibrationConfig(board=DESK, model=model))
        everywhere = projection_difference(given, found.cameras[0]).distance_px
        covered = projection_difference(given, found.cameras[0], covered_pixels(found, 0)).distance_px
        rows[model] = {
            "rms px": found.rms_px,
            "fx": found.cameras[0].K[0, 0],
            "difference px, whole image": float(np.nanmedian(everywhere)),
            "where corners were seen": float(np.nanmedian(covered)),
        }
    return rows


def main() -> None:
    """Print both tables and write the results."""
    parser = argparse.ArgumentParser(description="Camera calibration: epipole and OpenCV.")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    folder = data / "calibration" / "opencv_stereo"
    numbers = [f"{k:02d}.jpg" for k in range(1, 15) if k != 10]
    views = [[find_board(read_gray(folder / f"{s}{n}"), PAIR) for n in numbers] for s in ("left", "right")]
    without_rejection = CalibrationConfig(board=PAIR, outlier_factor=1e6, max_view_factor=1e6)
    default = CalibrationConfig(board=PAIR)
    our_pair(views, default)
    ours, theirs = get_context("spawn").Pipe()
    pixels = [[view.pixels.astype(np.float32) for view in of_camera] for of_camera in views]
    process = get_context("spawn").Process(target=opencv_pair, args=(theirs, pixels))
    process.start()
    rows = {"OpenCV, 13 views": ours.recv()}
    process.join()
    rows |= {
        "epipole, all corners": our_pair(views, without_rejection),
        "epipole": our_pair(views, default),
        "epipole, 10 views, 3 spoiled": our_pair(spoiled(views), default),
        "epipole, those 7 alone": our_pair(
            [[v for k, v in enumerate(of_camera[:10]) if k not in SPOILED] for of_camera in views], default
        ),
    }
    desk = desk_rows(data / "slam" / "ar_cube")
    console = Console(width=160)
    console.print(table_of("13 views of a board by a stereo pair", rows))
    console.print(table_of("37 views of a desk, against its given intrinsics", desk))
    arguments.results.mkdir(parents=True, exist_ok=True)
    report = {"machine": describe_machine(2), "pair": rows, "desk": desk}
    (arguments.results / "calibration.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
