"""Whether SLAM knows how well it knows a place: e^T C^-1 e of its errors. `python -m benchmarks.slam_covariance --runs 200`.

A ride is drawn once without noise, as a stereo pair of 320 x 240. Each run follows 40 frames of it, from another begin, in
either direction, with noise of its own; the world is its first frame's camera, as SLAM has it, so that nothing is aligned. Of six degrees of
freedom the mean over runs should be 6, within the band of two deviations. The calibration is exact, and the options say so.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.slam import Slam
from epipole.synthetic import rides
from epipole.synthetic.ride import Ride, Shutter

SIZE, COUNT, NOISE, SHOWN = (320, 240), 40, 2.0, (2, 5, 10, 20, 30, 39)
RIDES = {
    "loop_room": lambda: rides.loop_room(360, SIZE),
    "unshuttered": lambda: rides.shuttered(240, SIZE, 0.0),
}
RESULTS = REPOSITORY / "benchmarks" / "results" / "slam_covariance.json"


class Rendered:
    """Images of a ride without noise, and where they were taken."""

    def __init__(self, ride: Ride) -> None:
        clean = replace(ride, shutter=Shutter(noise_sigma=0.0))
        self.camera = SlamCamera(ride.camera, ride.baseline)
        self.pairs = [(clean.left(n).grey, clean.right(n).grey) for n in range(len(ride))]
        self.world_from_camera = ride.world_from_camera

    def tracked(self, first: int, step: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """(2, n) normalised squared errors of the answers as they came and at the end; NaN without a place."""
        rng, rows = np.random.default_rng(seed), first + step * np.arange(COUNT)
        slam = Slam(self.camera, SlamConfig(focal_sigma=0.0, center_sigma_px=0.0, depth_sigma=0.0))
        answers = []
        for k, n in enumerate(rows):
            left, right = (_noisy(image, rng) for image in self.pairs[n])
            answers.append(slam.track(Frame(k / 30.0, left, right)))
        slam.finish()
        path = slam.trajectory()
        frame = np.rint(30.0 * path.timestamp_s).astype(int)
        there = self.world_from_camera[rows]
        truth = there[0].inverse() @ there
        causal, final = np.full(COUNT, np.nan), np.full(COUNT, np.nan)
        for k, answer in enumerate(answers):
            if answer.world_from_body is not None and answer.covariance is not None:
                causal[k] = _normalised(answer.world_from_body, truth[k], answer.covariance)
        assert path.covariance is not None
        for row, k in enumerate(frame):
            final[k] = _normalised(path.world_from_body[row], truth[int(k)], path.covariance[row])
        return causal, final


def _noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    levels = image + NOISE * rng.standard_normal(image.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _normalised(stated: Rigid3, true: Rigid3, covariance: np.ndarray) -> float:
    """With body_from_world = exp(xi) @ stated."""
    if not np.isfinite(covariance).all() or np.linalg.cond(covariance) > 1e14:
        return float("nan")
    xi = (true.inverse() @ stated).log()
    return float(xi @ np.linalg.solve(covariance, xi))


def measured(name: str, runs: int) -> dict[str, Any]:
    """Means over runs, of the frames shown."""
    rendered, start = Rendered(RIDES[name]()), time.perf_counter()
    both = []
    rng = np.random.default_rng(3)
    for seed in range(runs):
        step = 1 if seed % 2 else -1
        low, high = (0, len(rendered.pairs) - COUNT) if step == 1 else (COUNT - 1, len(rendered.pairs) - 1)
        both.append(rendered.tracked(int(rng.integers(low, high + 1)), step, seed))
    found = np.array(both)
    out: dict[str, Any] = {"runs": runs, "band": 2.0 * float(np.sqrt(12.0 / runs)), "frames": {}}
    for k in SHOWN:
        values = found[:, :, k]
        out["frames"][k] = {
            kind: {
                "mean": float(np.nanmean(v)),
                "median": float(np.nanmedian(v)),
                "runs": int(np.isfinite(v).sum()),
            }
            for kind, v in (("as it came", values[:, 0]), ("final", values[:, 1]))
        }
    out["seconds"] = time.perf_counter() - start
    return out


def main() -> None:
    """Run the rides and print the table."""
    parser = argparse.ArgumentParser(description="Normalised squared errors of SLAM's places.")
    parser.add_argument("--ride", nargs="+", choices=list(RIDES), default=list(RIDES))
    parser.add_argument("--runs", type=int, default=200)
    arguments = parser.parse_args()
    report: dict[str, Any] = {"machine": describe_machine(1), "rides": {}}
    table = Table(title=f"e^T C^-1 e, mean of {arguments.runs} runs; 6 is right (median of chi-square: 5.3)")
    for column in ("ride", "frame", "as it came", "median", "final", "median", "band"):
        table.add_column(column, justify="right")
    for name in arguments.ride:
        row = report["rides"][name] = measured(name, arguments.runs)
        for k, kinds in row["frames"].items():
            numbers = [
                f"{kinds[kind][key]:.1f}" for kind in ("as it came", "final") for key in ("mean", "median")
            ]
            table.add_row(name, str(k), *numbers, f"6 +- {row['band']:.1f}")
    Console(width=120).print(table)
    if arguments.ride == list(RIDES) and arguments.runs >= 50:
        RESULTS.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
