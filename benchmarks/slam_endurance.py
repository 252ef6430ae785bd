"""Time and memory of SLAM over 20,000 frames of laps around the rendered room. `python -m benchmarks.slam_endurance`.

Each row is a thousand frames. On Linux, memory is RssAnon, which does not include the memory-mapped frames.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.peers.epipole_slam import camera_of, frames_of
from benchmarks.peers.slam_frames import SlamFrames, load_frames
from benchmarks.tasks.slam import prepare
from epipole.geometry import Rigid3
from epipole.io.trajectories.files import read_trajectory
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.output.autosave import Autosave
from epipole.pipelines.slam.output.record import FrameRecord
from epipole.pipelines.slam.output.results import keyframe_names
from epipole.pipelines.slam.slam import Slam
from epipole.runs import thread_scope

ROW = 1000
"""Frames per row."""
_UNIT = 1 if sys.platform == "darwin" else 1024
"""Bytes per unit of `ru_maxrss`."""
HEADINGS = {"placed": "localized"}


def main() -> None:
    """Track the frames, write a row for each thousand, and print the table."""
    arguments = _arguments()
    arguments.cache.mkdir(parents=True, exist_ok=True)
    folder = prepare("loop_room", Path(), arguments.cache.resolve())
    report: dict[str, Any] = {"machine": describe_machine(0), "sensor": arguments.sensor, "rows": []}
    report["mapping"] = arguments.mapping
    report["begin"] = datetime.now(UTC).isoformat(timespec="seconds")
    checkpoint = Path(tempfile.mkdtemp(prefix="epipole-endurance-"))
    try:
        with thread_scope():
            for row in _track(folder, arguments, checkpoint):
                report["rows"].append(row)
                report["end"] = datetime.now(UTC).isoformat(timespec="seconds")
                report["bytes_per_frame"] = _growth(report["rows"])
                Console(stderr=True).print(row)
                arguments.results.mkdir(parents=True, exist_ok=True)
                file = arguments.results / f"slam_endurance_{arguments.sensor}_{arguments.mapping}.json"
                file.write_text(json.dumps(report, indent=1) + "\n")
    finally:
        shutil.rmtree(checkpoint, ignore_errors=True)
    Console(width=120).print(_table(report))


def _track(folder: Path, arguments: argparse.Namespace, checkpoint: Path) -> Iterator[dict[str, Any]]:
    """Track the frames, in thread mode at the camera's rate, and yield the figures of every thousand."""
    sensor, mode, count = arguments.sensor, arguments.mapping, arguments.frames
    frames = load_frames(folder)
    truth = read_trajectory(folder / "truth_exact.txt").world_from_body
    truth = truth[0].inverse() @ truth
    system = Slam(camera_of(frames, sensor), mapping=mode)
    records, ms, errors = list[FrameRecord](), [], []
    autosave, saved_s = Autosave(checkpoint, Rigid3.identity(), can_repeat=False), 0.0
    autosave.start(system, records)
    cpu_start, num_maps = time.process_time(), 0
    late, begin = 0, time.perf_counter()
    for number, frame in enumerate(_laps(frames, sensor, count)):
        if mode == "thread":
            ahead = begin + frame.timestamp_s - time.perf_counter()
            late += ahead < -frames.timestamp_s[1]
            time.sleep(max(ahead, 0.0))
        start = time.perf_counter()
        answer = system.track(frame)
        seconds = time.perf_counter() - start
        records.append(FrameRecord(number, f"frame_{number:06d}.jpg", seconds, answer))
        autosave.add(system, records, lambda: keyframe_names(system, records, None))
        ms.append(1e3 * seconds)
        if answer.world_from_body is not None:
            true_position = truth[number % len(frames)].translation
            errors.append(float(np.linalg.norm(answer.world_from_body.translation - true_position)))
        if len(records) % ROW == 0 or len(records) == count:
            cpu = time.process_time()
            yield {
                "frames": len(records),
                "ms_mean": float(np.mean(ms)),
                "ms_median": float(np.median(ms)),
                "ms_p95": float(np.percentile(ms, 95)),
                "ms_max": float(np.max(ms)),
                "late": int(late),
                "cpu_ms_mean": 1e3 * (cpu - cpu_start) / len(ms),
                "checkpoint_ms_mean": 1e3 * (autosave.seconds - saved_s) / len(ms),
                "num_maps_saved": autosave.num_maps_saved - num_maps,
                "memory_mb": _memory_bytes() / 1e6,
                "checkpoint_mb": sum(p.stat().st_size for p in checkpoint.iterdir()) / 1e6,
                "keyframes": len(system.map.keyframes),
                "points": system.map.num_points,
                "places_compared": len(system.loops),
                "placed": len(errors),
                "largest_error_m": max(errors, default=None),
            }
            late = 0
            ms, errors, saved_s, num_maps = [], [], autosave.seconds, autosave.num_maps_saved
            cpu_start = time.process_time()
    autosave.close()


def _laps(frames: SlamFrames, sensor: str, count: int) -> Iterator[Frame]:
    """Repeat the sequence, with timestamps at its frame rate."""
    step, number = float(frames.timestamp_s[1] - frames.timestamp_s[0]), 0
    while number < count:
        for frame in frames_of(frames, sensor, min(len(frames), count - number)):
            yield replace(frame, timestamp_s=step * number)
            number += 1


def _memory_bytes() -> int:
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text().splitlines():
            if line.startswith("RssAnon"):
                return 1024 * int(line.split()[1])
    return _UNIT * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _growth(rows: list[dict[str, Any]]) -> float | None:
    """Bytes of memory per frame: slope of a line through the second half of the rows."""
    last_half = rows[len(rows) // 2 :]
    if len(last_half) < 3:
        return None
    return float(
        1e6 * np.polyfit([r["frames"] for r in last_half], [r["memory_mb"] for r in last_half], 1)[0]
    )


def _table(report: dict[str, Any]) -> Table:
    growth = report["bytes_per_frame"]
    words = "" if growth is None else f", {growth:.0f} bytes per frame in the second half"
    table = Table(title=f"laps around the room, {report['sensor']}{words}")
    columns = {
        **{
            "frames": ",",
            "ms_mean": ".1f",
            "ms_median": ".1f",
            "ms_p95": ".0f",
            "ms_max": ".0f",
            "late": "d",
            "cpu_ms_mean": ".1f",
        },
        **{"checkpoint_ms_mean": ".2f", "memory_mb": ".0f", "checkpoint_mb": ".0f", "keyframes": "d"},
        **{"points": ",", "placed": "d", "largest_error_m": ".4f"},
    }
    for name in columns:
        table.add_column(HEADINGS.get(name, name.replace("_", " ")), justify="right")
    for row in report["rows"]:
        table.add_row(
            *("" if row[name] is None else format(row[name], form) for name, form in columns.items())
        )
    return table


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Time and memory of SLAM over many frames.")
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--sensor", choices=("stereo", "rgbd", "mono"), default="stereo")
    parser.add_argument("--mapping", choices=("inline", "thread"), default="inline")
    parser.add_argument(
        "--cache",
        type=Path,
        default=Path(tempfile.gettempdir()) / "epipole-slam-frames",
        help="folder for rendered frames",
    )
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    return parser.parse_args()


if __name__ == "__main__":
    main()
