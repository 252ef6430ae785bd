"""Consistency of SLAM's pose covariances: e^T C^-1 e of its errors. `python -m benchmarks.slam_covariance --runs 200`.

Each run tracks 40 frames of a rendered sequence with new noise, from a random frame, forward or backward, with a stereo pair or a
depth sensor. The mean over the runs should be 6 (degrees of freedom), within two standard deviations. The calibration is exact.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.ndimage import gaussian_filter

from benchmarks.measure import REPOSITORY, describe_machine
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera
from epipole.pipelines.slam.slam import Slam
from epipole.synthetic import rides
from epipole.synthetic.ride import Ride, Shutter

SIZE = (320, 240)
NUM_FRAMES = 40
"""Number of frames in each run."""
DISPARITY_SIGMA_PX = 0.3
"""Noise of the depth sensor, as SLAM's option `depth_sigma_px`."""
SMOOTH_PX = 2.0
"""Width of that noise in pixels: sensors match patches, and depths that differ from pixel to pixel are rejected as edges."""
NOISE = 2.0
"""Standard deviation of the image noise in gray levels."""
SHOWN = (2, 5, 10, 20, 30, 39)
"""Frames in the table."""
RIDES = {
    "loop_room": lambda: rides.loop_room(360, SIZE),
    "unshuttered": lambda: rides.shuttered(240, SIZE, 0.0),
}
SENSORS = ("stereo", "depth")
RESULTS = REPOSITORY / "benchmarks" / "results" / "slam_covariance.json"


class Rendered:
    """Noise-free images of a sequence, with the right images or depths, and their true poses."""

    def __init__(self, ride: Ride, sensor: str) -> None:
        clean, has_depth = replace(ride, shutter=Shutter(noise_sigma=0.0)), sensor == "depth"
        depth = DepthCamera(ride.camera, Rigid3.identity()) if has_depth else None
        self.camera = SlamCamera(ride.camera, None if has_depth else ride.baseline, depth)
        self.left = [clean.left(n) for n in range(len(ride))]
        self.right = [] if has_depth else [clean.right(n).gray for n in range(len(ride))]
        self.world_from_camera = ride.world_from_camera
        exact = {"focal_sigma": 0.0, "center_sigma_px": 0.0, "depth_sigma": 0.0}
        self.config = SlamConfig(**exact, **({"depth_sigma_px": DISPARITY_SIGMA_PX} if has_depth else {}))

    def frame(self, number: int, timestamp_s: float, rng: np.random.Generator) -> Frame:
        """A frame with new noise."""
        left = self.left[number]
        if self.right:
            return Frame(timestamp_s, _noisy(left.gray, rng), _noisy(self.right[number], rng))
        focal_baseline = float(self.camera.camera.params[0]) * self.config.sensor_baseline_m
        with np.errstate(divide="ignore"):
            exact = focal_baseline / left.depth
        noise = gaussian_filter(rng.standard_normal(left.depth.shape), SMOOTH_PX)
        disparity = exact + DISPARITY_SIGMA_PX * 2.0 * np.sqrt(np.pi) * SMOOTH_PX * noise
        depth = np.where(disparity > 0, focal_baseline / np.maximum(disparity, 1e-6), 0.0)  # 0: unknown
        return Frame(timestamp_s, _noisy(left.gray, rng), None, depth.astype(np.float32))

    def tracked(self, first: int, step: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Normalized squared errors of the poses on arrival and of the final ones, (n,) each; NaN if unknown."""
        rng, rows = np.random.default_rng(seed), first + step * np.arange(NUM_FRAMES)
        slam = Slam(self.camera, self.config)
        answers = [slam.track(self.frame(int(n), k / 30.0, rng)) for k, n in enumerate(rows)]
        slam.finish()
        trajectory = slam.trajectory()
        frame = np.rint(30.0 * trajectory.timestamp_s).astype(int)
        world_from_camera = self.world_from_camera[rows]
        truth = world_from_camera[0].inverse() @ world_from_camera  # SLAM's world is its first camera
        causal, final = np.full(NUM_FRAMES, np.nan), np.full(NUM_FRAMES, np.nan)
        for k, answer in enumerate(answers):
            if answer.world_from_body is not None and answer.covariance is not None:
                causal[k] = _normalized(answer.world_from_body, truth[k], answer.covariance)
        assert trajectory.covariance is not None
        for row, k in enumerate(frame):
            final[k] = _normalized(trajectory.world_from_body[row], truth[int(k)], trajectory.covariance[row])
        return causal, final


def _noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    levels = image + NOISE * rng.standard_normal(image.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _normalized(estimate: Rigid3, true: Rigid3, covariance: np.ndarray) -> float:
    """Squared error xi^T C^-1 xi with exp(xi) = true^-1 @ estimate."""
    if not np.isfinite(covariance).all() or np.linalg.cond(covariance) > 1e14:
        return float("nan")
    xi = (true.inverse() @ estimate).log()
    return float(xi @ np.linalg.solve(covariance, xi))


def measured(name: str, sensor: str, runs: int) -> dict[str, Any]:
    """Means and medians over the runs, for the frames in SHOWN."""
    rendered, start = Rendered(RIDES[name](), sensor), time.perf_counter()
    errors = []
    rng = np.random.default_rng(3)
    for seed in range(runs):
        step = 1 if seed % 2 else -1
        low, high = (
            (0, len(rendered.left) - NUM_FRAMES) if step == 1 else (NUM_FRAMES - 1, len(rendered.left) - 1)
        )
        errors.append(rendered.tracked(int(rng.integers(low, high + 1)), step, seed))
    found = np.array(errors)
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
    """Run the sequences and print the table."""
    parser = argparse.ArgumentParser(description="Normalized squared errors of SLAM's poses.")
    parser.add_argument("--ride", nargs="+", choices=list(RIDES), default=list(RIDES))
    parser.add_argument("--sensor", nargs="+", choices=SENSORS, default=list(SENSORS))
    parser.add_argument("--runs", type=int, default=200)
    arguments = parser.parse_args()
    report: dict[str, Any] = {"machine": describe_machine(1), "rides": {}}
    table = Table(title=f"e^T C^-1 e, mean of {arguments.runs} runs; expected: 6 (median: 5.3)")
    for column in ("sequence", "sensor", "frame", "on arrival", "median", "final", "median", "band"):
        table.add_column(column, justify="right")
    for name, sensor in product(arguments.ride, arguments.sensor):
        row = report["rides"][f"{name}, {sensor}"] = measured(name, sensor, arguments.runs)
        for k, kinds in row["frames"].items():
            numbers = [
                f"{kinds[kind][key]:.1f}" for kind in ("as it came", "final") for key in ("mean", "median")
            ]
            table.add_row(name, sensor, str(k), *numbers, f"6 +- {row['band']:.1f}")
    Console(width=120).print(table)
    if (arguments.ride, arguments.sensor) == (list(RIDES), list(SENSORS)) and arguments.runs >= 50:
        RESULTS.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
