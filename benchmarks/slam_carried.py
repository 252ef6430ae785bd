"""SLAM with an IMU through two seconds without images. `python -m benchmarks.slam_carried`.

A rendered ride through a room, at 10 frames per second and 320 x 240 pixels; for two seconds all images are dark. IMUs differ in noise,
biases, gain, mounting and clock offset. Results: `results/slam_carried.json`.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from epipole._parallel import num_threads
from epipole.geometry import Rigid3
from epipole.inertial import ImuLog, MountedImu
from epipole.metrics import absolute_error
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera, TrackedFrame, TrackingState
from epipole.pipelines.slam.slam import Slam
from epipole.synthetic.inertial import imu_along
from epipole.synthetic.rides import loop_room

NUM_FRAMES, STEP, RATE_HZ = 400, 4, 10.0
GAP = 20
"""Frames without images."""
STARTS = (55, 65, 75)
MOUNTING_SIGMA = np.repeat([0.05, 0.5], 3)
"""Standard deviations of the IMU's pose on the camera, in meters and radians."""
LARGEST_OFFSET_S = 0.05


def main() -> None:
    """Run all trials, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=4, help="IMUs for each of the gaps")
    parser.add_argument("--sensor", nargs="+", choices=("stereo", "depth"), default=["stereo", "depth"])
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    rows = [summary_of(kind, arguments.seeds) for kind in arguments.sensor]
    table = Table(
        "sensor",
        "trials",
        "carried",
        "one map",
        "error, % of the distance",
        "largest",
        "error / sigma",
        "final, mm",
    )
    for row in rows:
        table.add_row(
            *(row["sensor"], f"{row['trials']}", f"{row['carried']}", f"{row['one_map']}"),
            *(f"{row['median_percent']:.2f}", f"{row['largest_percent']:.2f}"),
            *(f"{row['median_error_over_sigma']:.2f}", f"{row['median_final_mm']:.1f}"),
        )
    Console().print(table)
    content = {"machine": describe_machine(num_threads()), "rows": rows}
    (arguments.results / "slam_carried.json").write_text(json.dumps(content, indent=1) + "\n")


def summary_of(kind: str, seeds: int) -> dict[str, Any]:
    """Numbers over all gaps and IMUs."""
    ride = loop_room(NUM_FRAMES, (320, 240))
    numbers = np.arange(0, NUM_FRAMES, STEP)
    frames = [_frame(ride, int(number), n, kind) for n, number in enumerate(track(numbers, "Rendering"))]
    truth = ride.world_from_camera[numbers]
    truth = truth[0].inverse() @ truth
    camera = ride.camera
    depth = DepthCamera(camera, Rigid3.identity()) if kind == "depth" else None
    sensor = SlamCamera(camera, ride.baseline if kind == "stereo" else None, depth)
    trials = [(start, seed) for start in STARTS for seed in range(seeds)]
    found = [trial(sensor, frames, truth, start, seed) for start, seed in track(trials, f"With {kind}")]
    carried = [one for one in found if one["is_carried"]]

    def median(name: str) -> float:
        return float(np.median([one[name] for one in carried]))

    return {
        "sensor": kind,
        "trials": len(found),
        "carried": len(carried),
        "one_map": sum(one["num_maps"] == 1 for one in found),
        "median_percent": median("percent"),
        "largest_percent": max(one["percent"] for one in carried),
        "median_error_over_sigma": median("error_over_sigma"),
        "median_final_mm": median("final_mm"),
        "each": found,
    }


def trial(sensor: SlamCamera, frames: list[Frame], truth: Rigid3, start: int, seed: int) -> dict[str, Any]:
    """One run: the error of the last carried frame, and of the whole trajectory."""
    rng, times = np.random.default_rng([3, seed]), np.array([frame.timestamp_s for frame in frames])
    mounting, offset = Rigid3.exp(rng.normal(size=6) * MOUNTING_SIGMA), rng.uniform(-1, 1) * LARGEST_OFFSET_S
    log = imu_along(times, truth, mounting, seed)
    system = Slam(
        sensor, imu=MountedImu(ImuLog(log.timestamp_s + offset, log.gyro_rad_s, log.accel_m_s2), mounting)
    )
    dark = range(start, start + GAP)
    answers = [system.track(_darkened(frame) if n in dark else frame) for n, frame in enumerate(frames)]
    system.finish()
    path = system.trajectory()
    rows = np.rint(RATE_HZ * path.timestamp_s).astype(int)
    final = absolute_error(path.world_from_body, truth[rows], "rigid").position.rmse
    return {
        **_carried(answers, truth, dark),
        "offset_s": offset,
        "num_maps": len(system.maps),
        "final_mm": 1e3 * final,
    }


def _carried(answers: list[TrackedFrame], truth: Rigid3, dark: range) -> dict[str, Any]:
    """Of the last dark frame: its error since the last one with an image, as a fraction of the distance, and by its deviation."""
    last, before = answers[dark[-1]], answers[dark[0] - 1]
    if last.state is not TrackingState.INERTIAL or last.world_from_body is None or last.covariance is None:
        return {"is_carried": False}
    assert before.world_from_body is not None
    went = before.world_from_body.inverse() @ last.world_from_body
    true = truth[dark[0] - 1].inverse() @ truth[dark[-1]]
    error = float(np.linalg.norm(went.translation - true.translation))
    steps = np.diff(truth.translation[dark[0] - 1 : dark[-1] + 1], axis=0)
    sigma = float(np.sqrt(np.trace(last.covariance[:3, :3])))
    distance = float(np.linalg.norm(steps, axis=1).sum())
    return {
        "is_carried": True,
        "error_m": error,
        "distance_m": distance,
        "percent": 100.0 * error / distance,
        "error_over_sigma": error / sigma,
    }


def _frame(ride: Any, number: int, n: int, kind: str) -> Frame:
    left = ride.left(number)
    right = ride.right(number).gray if kind == "stereo" else None
    return Frame(n / RATE_HZ, left.gray, right, left.depth if kind == "depth" else None)


def _darkened(frame: Frame) -> Frame:
    right, depth = frame.right_gray, frame.depth
    return replace(
        frame,
        gray=np.full_like(frame.gray, 2),
        right_gray=None if right is None else np.full_like(right, 2),
        depth=None if depth is None else np.zeros_like(depth),
    )


if __name__ == "__main__":
    main()
