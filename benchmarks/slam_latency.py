"""Time per frame of `Slam.track` at a camera's rate, with the map adjusted inline and in a thread. `python -m benchmarks.slam_latency`.

Frames are given at their times, as a camera does. A frame is late if it arrives more than one period before tracking takes it; a live
camera would have dropped it. Sequences go forth and back until there are enough frames. Results: `results/slam_latency.json`, or
`results/slam_keyframes.json` with `--no-keyframe-rotation`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.tasks.sfm import data_root
from epipole.geometry import Rigid3
from epipole.io.sequences.sequence import read_sequence
from epipole.io.trajectories.true_trajectories import true_path_at
from epipole.metrics import absolute_error, associate
from epipole.pipelines.slam.config import JobOptions, SlamConfig
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.sources.folder import open_sequence
from epipole.pipelines.slam.sources.frame_stream import FrameStream
from epipole.scene import Trajectory
from epipole.synthetic import rides

WARM = 5
"""First frames, which compile kernels and initialize the map."""
MODES: tuple[Literal["inline", "thread"], ...] = ("inline", "thread")


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """Frames in memory, their rate, and their true poses if they are known."""

    camera: SlamCamera
    frames: list[Frame]
    rate_hz: float
    truth: Rigid3 | None


def main() -> None:
    """Track every sequence in both modes, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sequence", nargs="+", choices=SEQUENCES, default=list(SEQUENCES))
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    parser.add_argument("--keyframe-rotation", action=argparse.BooleanOptionalAction, default=True)
    arguments = parser.parse_args()
    config = SlamConfig(keyframe_rotation=arguments.keyframe_rotation)
    rows = []
    for name in arguments.sequence:
        recorded = SEQUENCES[name](data_root(arguments.data))
        _run(recorded, 60, "inline", config)  # compiles kernels
        for mode in MODES:
            rows.append({"sequence": name, "mapping": mode, **_run(recorded, arguments.frames, mode, config)})
            print(rows[-1])
    Console(width=150).print(_table(rows))
    report = {"machine": describe_machine(2), "rows": rows}
    name = "slam_latency" if arguments.keyframe_rotation else "slam_keyframes"
    (arguments.results / f"{name}.json").write_text(json.dumps(report, indent=1) + "\n")


def _folder(data: Path, name: str, sensor: str, rate_hz: float, truth: str, truth_hz: float) -> Recorded:
    folder = data / "slam" / name
    source = open_sequence(read_sequence(folder, None, None), sensor, None, None)
    frames = [queued.read() for queued in FrameStream(source, JobOptions())]
    path = true_path_at(folder / truth).trajectory
    ours = Trajectory(np.array([frame.timestamp_s for frame in frames]), Rigid3.identity(len(frames)))
    if not path.is_timed:
        return Recorded(source.camera, frames, rate_hz, path.world_from_body[np.arange(len(frames))])
    path = Trajectory(path.timestamp_s / truth_hz, path.world_from_body)
    rows, of_truth = associate(ours, path, 0.03)
    assert len(rows) == len(frames)
    return Recorded(source.camera, frames, rate_hz, path.world_from_body[of_truth])


def _room(_data: Path) -> Recorded:
    ride = rides.loop_room(400)
    images = [(ride.left(n).gray, ride.right(n).gray) for n in range(400)]
    frames = [Frame(n / 30.0, left, right) for n, (left, right) in enumerate(images)]
    return Recorded(SlamCamera(ride.camera, ride.baseline), frames, 30.0, ride.world_from_camera)


def _large_room(_data: Path) -> Recorded:
    ride = rides.loop_room(200, (1280, 720))
    frames = [Frame(n / 30.0, ride.left(n).gray) for n in range(200)]
    return Recorded(SlamCamera(ride.camera), frames, 30.0, ride.world_from_camera)


SEQUENCES = {
    "loop room, stereo 640 x 480": _room,
    "loop room, one camera 1280 x 720": _large_room,
    "kitti06, stereo": lambda data: _folder(data, "kitti06_stereo", "stereo", 10.0, "poses.txt", 1.0),
    "kitchen, depth": lambda data: _folder(data, "7scenes", "rgbd", 30.0, "poses_sfm.txt", 30.0),
    "kitchen, one camera": lambda data: _folder(data, "7scenes", "mono", 30.0, "poses_sfm.txt", 30.0),
}


def _order(count: int, wanted: int) -> Iterator[int]:
    """Numbers of frames, forth and back."""
    period = max(2 * count - 2, 1)
    for n in range(wanted):
        k = n % period
        yield k if k < count else period - k


def _run(
    recorded: Recorded, wanted: int, mode: Literal["inline", "thread"], config: SlamConfig
) -> dict[str, Any]:
    """Figures of one run."""
    slam, rate, processor = Slam(recorded.camera, config, mapping=mode), recorded.rate_hz, time.process_time()
    order, seconds, late, poses, keyframes = list(_order(len(recorded.frames), wanted)), [], 0, {}, 0
    begin = time.perf_counter()
    for n, k in enumerate(order):
        behind = time.perf_counter() - begin - n / rate
        late += behind > 1.0 / rate
        time.sleep(max(0.0, -behind))
        start = time.perf_counter()
        found = slam.track(replace(recorded.frames[k], timestamp_s=n / rate))
        seconds.append(time.perf_counter() - start)
        keyframes += found.is_keyframe
        if found.world_from_body is not None:
            poses[n] = found.world_from_body
    slam.finish()
    ms = 1e3 * np.array(seconds[WARM:])
    path = slam.trajectory()
    final = dict(
        zip(np.rint(path.timestamp_s * rate).astype(int).tolist(), path.world_from_body, strict=True)
    )
    return {
        "frames": wanted,
        "tracked": len(poses),
        "late": int(late),
        "keyframes": keyframes,
        "processor_s": time.process_time() - processor,
        "merged": 0 if slam.mapping_thread is None else slam.mapping_thread.num_merged,
        "median_ms": float(np.median(ms)),
        "p95_ms": float(np.percentile(ms, 95)),
        "max_ms": float(ms.max()),
        "causal_m": _error(recorded, order, poses),
        "final_m": _error(recorded, order, final),
    }


def _error(recorded: Recorded, order: list[int], poses: dict[int, Rigid3]) -> float | None:
    """Root mean square of the position errors, after rigid alignment, for one camera after a similarity."""
    if recorded.truth is None or len(poses) < 3:
        return None
    numbers = sorted(poses)
    ours = Rigid3(
        np.stack([poses[n].rotation for n in numbers]), np.stack([poses[n].translation for n in numbers])
    )
    true = recorded.truth[np.array([order[n] for n in numbers])]
    alignment = "rigid" if recorded.camera.measures_depth else "similarity"
    return absolute_error(ours, true, alignment).position.rmse


def _table(rows: list[dict[str, Any]]) -> Table:
    out = Table(title="time per frame")
    headings = ("sequence", "mapping", "tracked", "late", "median", "95 %", "max (ms)", "causal", "final (m)")
    for heading in headings:
        out.add_column(heading, justify="left" if heading in headings[:2] else "right")
    for row in rows:
        times = [f"{row[name]:.0f}" for name in ("median_ms", "p95_ms", "max_ms")]
        off = ["-" if row[name] is None else f"{row[name]:.4f}" for name in ("causal_m", "final_m")]
        tracked = f"{row['tracked']} of {row['frames']}"
        out.add_row(row["sequence"], row["mapping"], tracked, str(row["late"]), *times, *off)
    return out


if __name__ == "__main__":
    main()
