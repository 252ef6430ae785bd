"""Accuracy and time of dense stereo on real pairs, compared with OpenCV and pandora. `python -m benchmarks.stereo`.

Each program runs in its own process, in turn, after a warm-up; the table has medians of the rounds.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.side_by_side import compare, table_of
from benchmarks.tasks.stereo import StereoTask, figures, stereo_tasks

Pairs = list[tuple[np.ndarray, np.ndarray, int]]
"""Left image, right image, number of disparities."""


def match_with_epipole(paths: int, left_right: str, pairs: Pairs, threads: int) -> list[np.ndarray]:
    """Match with `match_stereo`: disparities and their standard deviations, (2, h, w)."""
    from epipole import _parallel
    from epipole.disparity_search.search import match_stereo
    from epipole.pipelines.stereo.config import StereoConfig

    _parallel.set_num_threads(threads)
    found = [
        match_stereo(
            left, right, StereoConfig(max_disparity_px=count - 1, paths=paths, left_right=left_right)
        )
        for left, right, count in pairs
    ]
    return [np.stack([f.disparity_px, f.sigma_px]) for f in found]


def match_with_opencv(mode: str, block: int, pairs: Pairs, threads: int) -> list[np.ndarray]:
    """Match with cv2.StereoBM or StereoSGBM, whose penalties are those of the documentation (8 and 32 times the block's area)."""
    import cv2

    cv2.setNumThreads(threads)
    out = []
    for left, right, count in pairs:
        if mode == "BM":
            matcher = cv2.StereoBM_create(count, block)
        else:
            penalty = block * block
            flag = getattr(cv2, f"StereoSGBM_MODE_{mode}")
            matcher = cv2.StereoSGBM_create(
                0, count, block, 8 * penalty, 32 * penalty, 1, 63, 10, 100, 2, flag
            )
        sixteenths = matcher.compute(left, right)
        out.append(np.where(sixteenths >= 0, sixteenths / 16.0, np.nan))
    return out


def match_with_pandora(pairs: Pairs, threads: int, with_confidence: bool = False) -> list[np.ndarray]:
    """Match with pandora and libSGM: 5 x 5 census, eight paths, V-fit, median, accurate cross-check.

    With `with_confidence`, the result has the disparities and their ambiguity, (2, h, w).
    """
    import pandora
    import xarray as xr
    from pandora.img_tools import add_disparity
    from pandora.state_machine import PandoraMachine

    os.environ["NUMBA_NUM_THREADS"] = str(threads)
    pandora.import_plugin()
    penalties = {"P1": 8, "P2": 32, "p2_method": "constant", "penalty_method": "sgm_penalty"}
    steps = {
        "matching_cost": {"matching_cost_method": "census", "window_size": 5, "subpix": 1},
        **({"cost_volume_confidence": {"confidence_method": "ambiguity"}} if with_confidence else {}),
        "optimization": {"optimization_method": "sgm", "overcounting": False, "penalty": penalties},
        "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
        "refinement": {"refinement_method": "vfit"},
        "filter": {"filter_method": "median"},
        "validation": {"validation_method": "cross_checking_accurate"},
    }

    def dataset(image: np.ndarray, low: int, high: int) -> Any:
        height, width = image.shape
        axes = {"row": np.arange(height), "col": np.arange(width)}
        out = xr.Dataset({"im": (["row", "col"], image.astype(np.float32))}, coords=axes)
        out.attrs = {
            "no_data_img": -9999,
            "valid_pixels": 0,
            "no_data_mask": 1,
            "crs": None,
            "transform": None,
        }
        return out.pipe(add_disparity, disparity=[low, high], window=None)

    out = []
    for left, right, count in pairs:
        found, _ = pandora.run(
            PandoraMachine(), dataset(left, 1 - count, 0), dataset(right, 0, count - 1), {"pipeline": steps}
        )
        bits = found["validity_mask"].data.astype(int)
        # Bits 0, 1 and 6 to 11 mark invalid pixels (no data, occluded, mismatched); 2 to 5 are warnings.
        invalid = (bits & 0b111111000011) != 0
        disparity = np.where(invalid, np.nan, -found["disparity_map"].data)
        if with_confidence:
            names = [str(n) for n in found["confidence_measure"].indicator.data]
            ambiguity = next(k for k, name in enumerate(names) if "ambiguity" in name)
            disparity = np.stack([disparity, found["confidence_measure"].data[:, :, ambiguity]])
        out.append(disparity)
    return out


PROGRAMS: dict[str, tuple[Callable[..., Any], int]] = {
    "epipole, 8 paths": (partial(match_with_epipole, 8, "accurate"), 2),
    "epipole, 8 paths, fast check": (partial(match_with_epipole, 8, "fast"), 2),
    "epipole, 4 paths, fast check": (partial(match_with_epipole, 4, "fast"), 2),
    "OpenCV SGBM 3": (partial(match_with_opencv, "SGBM", 3), 2),
    "OpenCV SGBM 5": (partial(match_with_opencv, "SGBM", 5), 2),
    "OpenCV HH 3": (partial(match_with_opencv, "HH", 3), 2),
    "OpenCV HH 5": (partial(match_with_opencv, "HH", 5), 2),
    "OpenCV HH4 3": (partial(match_with_opencv, "HH4", 3), 2),
    "OpenCV HH4 5": (partial(match_with_opencv, "HH4", 5), 2),
    "OpenCV 3WAY 3": (partial(match_with_opencv, "SGBM_3WAY", 3), 2),
    "OpenCV 3WAY 5": (partial(match_with_opencv, "SGBM_3WAY", 5), 2),
    "OpenCV BM 15": (partial(match_with_opencv, "BM", 15), 2),
    "pandora": (match_with_pandora, 2),
}


def large_pair(connection: Any) -> None:
    """Match a rendered pair of 4000 x 3000 pixels with 256 disparities; send time, peak memory and errors."""
    import resource
    import time

    from epipole.disparity_search.search import match_stereo
    from epipole.pipelines.stereo.config import StereoConfig
    from epipole.synthetic.stereo_rooms import stereo_room

    pair = stereo_room(5, (4000, 3000))
    match_stereo(pair.left[:64, :300], pair.right[:64, :300], StereoConfig(max_disparity_px=63))
    start = time.perf_counter()
    found = match_stereo(pair.left, pair.right, StereoConfig(max_disparity_px=255))
    seconds = time.perf_counter() - start
    error = np.abs(found.disparity_px - pair.disparity_px)
    connection.send(
        {
            "seconds": seconds,
            "peak MB, rendering included": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "known %": 100.0 * found.density,
            "bad 1 %": 100.0 * float((error[np.isfinite(error)] > 1).mean()),
        }
    )


def at_density(found: np.ndarray, task: StereoTask, density: float) -> dict[str, float]:
    """Error rates of our disparities with the smallest standard deviations, at the density of another program."""
    disparity, sigma = found
    order = np.sort(sigma[task.seen & np.isfinite(disparity)])
    count = min(len(order), round(density / 100.0 * int(task.seen.sum())))
    selected = figures(np.where(sigma <= order[count - 1], disparity, np.nan), task)
    return {f"our surest: {name}": selected[name] for name in ("density %", "bad 1 %", "bad 2 %")}


def main() -> None:
    """Match every pair with every program and print the tables."""
    parser = argparse.ArgumentParser(description="Dense stereo: epipole, OpenCV and pandora.")
    parser.add_argument("--set", nargs="+", help="pairs to match (default: all)")
    parser.add_argument("--program", nargs="+", help="prefixes of the programs to run (default: all)")
    parser.add_argument("--large", action="store_true", help="match a rendered pair of 12 megapixels instead")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    if arguments.large:
        ours, theirs = get_context("spawn").Pipe()
        process = get_context("spawn").Process(target=large_pair, args=(theirs,))
        process.start()
        row = ours.recv()
        process.join()
        Console().print(table_of("4000 x 3000 pixels, 256 disparities", {"epipole": row}))
        return
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    report: dict[str, Any] = {"machine": describe_machine(2)}
    chosen = {
        name: program
        for name, program in PROGRAMS.items()
        if not arguments.program or any(name.startswith(p) for p in arguments.program)
    }
    for name, task in stereo_tasks(data).items():
        if arguments.set and name not in arguments.set:
            continue
        pair = (task.left, task.right, task.num_disparities)
        found_by_us: list[np.ndarray] = []

        def judge(
            out: list[np.ndarray], task: StereoTask = task, found_by_us: list[np.ndarray] = found_by_us
        ) -> dict[str, float]:
            if out[0].ndim == 3:
                found_by_us.append(out[0])
                return figures(out[0][0], task)
            return figures(out[0], task)

        rows = compare(chosen, [pair], arguments.rounds, judge)
        for program, row in rows.items():
            if found_by_us and "density %" in row and not program.startswith("epipole"):
                row |= at_density(found_by_us[0], task, row["density %"])
        for row in rows.values():
            row["s/Mpx at 128"] = row["seconds"] / (task.left.size / 1e6) * (128 / task.num_disparities)
        report[name] = rows
        Console(width=170).print(table_of(name, rows))
    arguments.results.mkdir(parents=True, exist_ok=True)
    (arguments.results / "stereo.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
