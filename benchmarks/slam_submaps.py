"""Separate maps: joined where the camera revisits an area, and only there. `python -m benchmarks.slam_submaps`.

Rendered frames at 10 per second and 320 x 240 pixels, twice dark for a second at times that depend on the seed, with additional noise.

- revisited: two rounds through a room. Every part of it is seen twice, so that the maps can be joined.
- kidnapped: from the room into a corridor between two frames. Both look alike in parts, but are different rooms.

Results: `results/slam_submaps.json`.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from epipole._parallel import num_threads
from epipole.geometry import Rigid3
from epipole.metrics import absolute_error
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera
from epipole.pipelines.slam.slam import Slam
from epipole.synthetic.ride import Ride
from epipole.synthetic.rides import corridor, loop_room

SIZE, RATE_HZ = (320, 240), 10.0
STEP = 4
"""Degrees between two frames in the room; in the corridor, 20 cm."""
ROOM = range(0, 720, STEP)
CORRIDOR = range(240, 540, STEP)
"""Its end and the way back: textured throughout."""
KIDNAPPED = 60
"""Frames in the room before the camera is in the corridor."""
DARK = 10
"""Dark frames of each loss."""
NOISE = 3.0
"""Standard deviation of the additional noise, in gray levels."""
LARGEST_M = 0.05
"""Joined maps with a larger error (root mean square) are joined wrongly."""
SENSORS = ("stereo", "depth", "mono")


def main() -> None:
    """Run all trials, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--sensor", nargs="+", choices=SENSORS, default=list(SENSORS))
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    rows = [
        summary_of(scene, kind, arguments.seeds)
        for kind in arguments.sensor
        for scene in ("revisited", "kidnapped")
    ]
    table = Table(
        "scene", "sensor", "trials", "one map", "right", "frames in it, %", "error, mm (median, largest)"
    )
    for row in rows:
        table.add_row(
            *(row["scene"], row["sensor"], f"{row['trials']}", f"{row['one_map']}", f"{row['right']}"),
            f"{row['median_percent']:.0f}",
            f"{row['median_mm']:.1f}, {row['largest_mm']:.1f}",
        )
    Console(width=120).print(table)
    report = {"machine": describe_machine(num_threads()), "rows": rows}
    (arguments.results / "slam_submaps.json").write_text(json.dumps(report, indent=1) + "\n")


def summary_of(scene: str, kind: str, seeds: int) -> dict[str, Any]:
    """All seeds of a scene: revisited areas must be joined, different rooms must not."""
    found = [trial(scene, kind, seed) for seed in track(range(seeds), f"{scene}, {kind}")]
    is_one = scene == "revisited"
    return {
        "scene": scene,
        "sensor": kind,
        "trials": seeds,
        "one_map": sum(one["num_maps"] == 1 for one in found),
        "right": sum(
            (one["num_maps"] == 1) == is_one and one["largest_mm"] < 1e3 * LARGEST_M for one in found
        ),
        "median_percent": float(np.median([one["percent"] for one in found])),
        "median_mm": float(np.median([one["largest_mm"] for one in found])),
        "largest_mm": max(one["largest_mm"] for one in found),
        "each": found,
    }


def trial(scene: str, kind: str, seed: int) -> dict[str, Any]:
    """One run: the number of maps, the fraction of the frames in the first one, and the largest error of a map's trajectory."""
    rng = np.random.default_rng([5, seed])
    sensor, frames, truth = _frames(scene, kind)
    first, second = int(rng.integers(20, 40)), int(rng.integers(80, 100))
    dark = {*range(first, first + DARK), *range(second, second + DARK)}
    system = Slam(sensor, SlamConfig(seed=seed))
    for n, frame in enumerate(frames):
        system.track(_disturbed(frame, rng, is_dark=n in dark))
    system.finish()
    errors = []
    for number in range(len(system.maps)):
        path = system.trajectory(number)
        rows = np.rint(RATE_HZ * path.timestamp_s).astype(int)
        if len(rows) >= 3:
            alignment = "similarity" if kind == "mono" else "rigid"
            errors.append(absolute_error(path.world_from_body, truth[rows], alignment).position.rmse)
    return {
        "num_maps": len(system.maps),
        "percent": 100.0 * len(system.trajectory()) / (len(frames) - len(dark)),
        "largest_mm": 1e3 * max(errors),
    }


@cache
def _frames(scene: str, kind: str) -> tuple[SlamCamera, list[Frame], Rigid3]:
    room, other = loop_room(max(ROOM) + 1, SIZE), corridor(size=SIZE)
    seen = (
        [(room, k) for k in ROOM]
        if scene == "revisited"
        else [(room, k) for k in ROOM[:KIDNAPPED]] + [(other, k) for k in CORRIDOR]
    )
    poses = Rigid3.stack([ride.world_from_camera[k] for ride, k in seen])
    sensor = SlamCamera(
        room.camera,
        room.baseline if kind == "stereo" else None,
        DepthCamera(room.camera, Rigid3.identity()) if kind == "depth" else None,
    )
    return sensor, [_frame(ride, k, n, kind) for n, (ride, k) in enumerate(seen)], poses


def _frame(ride: Ride, number: int, n: int, kind: str) -> Frame:
    left = ride.left(number)
    right = ride.right(number).gray if kind == "stereo" else None
    return Frame(n / RATE_HZ, left.gray, right, left.depth if kind == "depth" else None)


def _disturbed(frame: Frame, rng: np.random.Generator, *, is_dark: bool) -> Frame:
    def noisy(gray: np.ndarray) -> np.ndarray:
        shown = 2.0 if is_dark else gray.astype(float)
        return np.clip(shown + rng.normal(0.0, NOISE, gray.shape), 0, 255).astype(np.uint8)

    right, depth = frame.right_gray, frame.depth
    return replace(
        frame,
        gray=noisy(frame.gray),
        right_gray=None if right is None else noisy(right),
        depth=np.zeros_like(depth) if is_dark and depth is not None else depth,
    )


if __name__ == "__main__":
    main()
