"""Record the replays of the lesson's page on failures: SLAM runs on rendered sequences. `python -m benchmarks.lesson_replays`.

The package contains only rendered images; for 7-Scenes' kitchen, it contains only the errors.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import tempfile
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from rich.console import Console

import epipole
from benchmarks.measure import REPOSITORY
from epipole.geometry import Rigid3, align_points
from epipole.io.trajectories.files import read_pose_matrix
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera, TrackedFrame
from epipole.pipelines.slam.slam import Slam
from epipole.synthetic import rides
from epipole.synthetic.ride import Ride, Shutter

RECORD = REPOSITORY / "src" / "epipole" / "lesson" / "assets" / "failures.json"
SIZE = (320, 240)
"""Size of the images that SLAM gets."""
SHOWN_SIZE = (176, 132)
"""Size of the images on the page."""
LESSON_STATES = {"rotating": "turning"}
"""States whose names in the replays of the lesson differ."""
MAX_SHOWN = 26
"""Maximum number of images of one run on the page."""
QUALITY = 40
"""WebP quality of the images; low, to keep the package small."""


class Sight(NamedTuple):
    """A rendered sequence and the sensor that records it."""

    ride: Ride
    every: int
    """Use every n-th frame."""
    sensor: str
    readout_s: float = 0.0
    """Readout time of the rolling shutter that SLAM is given."""


def blurred(exposure_s: float) -> Ride:
    """A shaking hand-held camera with this exposure time."""
    shutter = Shutter(exposure_s=exposure_s, num_exposures=16)
    return replace(rides.shuttered(240, SIZE, 0.0), shutter=shutter)


def failures() -> dict[str, dict[str, Sight]]:
    """The runs to record: one or two by name for each failure."""
    rolling_shutter = rides.shuttered(240, SIZE)
    rotating, walking = rides.rotate_only(200, SIZE), rides.walking_box(240, SIZE)
    return {
        "wall": {"rgbd": Sight(rides.corridor(620, SIZE), 4, "rgbd")},
        "tiles": {"rgbd": Sight(rides.tiled_room(400, SIZE), 4, "rgbd")},
        "moving": {"rgbd": Sight(walking, 4, "rgbd"), "mono": Sight(walking, 4, "mono")},
        "blur": {"long": Sight(blurred(0.12), 3, "mono"), "short": Sight(blurred(0.01), 3, "mono")},
        "shutter": {
            "untold": Sight(rolling_shutter, 3, "mono"),
            "told": Sight(rolling_shutter, 3, "mono", readout_s=0.03),
        },
        "rotation": {"mono": Sight(rotating, 4, "mono"), "rgbd": Sight(rotating, 4, "rgbd")},
    }


def frames_of(sight: Sight) -> Iterable[tuple[int, Frame]]:
    """Number and image data of each frame, with the timestamps of the sequence."""
    for number in range(0, len(sight.ride), sight.every):
        left = sight.ride.left(number)
        depth = left.depth if sight.sensor == "rgbd" else None
        yield number, Frame(float(sight.ride.timestamp_s[number]), left.gray, None, depth)


def camera_of(sight: Sight) -> SlamCamera:
    """The camera, with the readout time that SLAM is given."""
    camera = sight.ride.camera
    depth = DepthCamera(camera, Rigid3.identity()) if sight.sensor == "rgbd" else None
    return SlamCamera(camera, None, depth, readout_s=sight.readout_s)


def recorded(sight: Sight) -> dict[str, Any]:
    """Run SLAM: state, message and position of every frame as it arrived, final positions, and the ground truth."""
    slam, answers, images, numbers = Slam(camera_of(sight)), list[TrackedFrame](), list[np.ndarray](), []
    for number, frame in frames_of(sight):
        answers.append(slam.track(frame))
        images.append(frame.gray)
        numbers.append(number)
    slam.finish()
    truth = sight.ride.world_from_camera[np.array(numbers)]
    final = slam.trajectory()
    rows = np.searchsorted([a.timestamp_s for a in answers], final.timestamp_s - 1e-6)
    known = [k for k, a in enumerate(answers) if a.world_from_body is not None]
    causal = np.array([answers[k].world_from_body.translation for k in known]).reshape(-1, 3)
    shown = np.unique(np.linspace(0, len(answers) - 1, MAX_SHOWN).astype(int))
    moving = [[*a.moving.low_px, *a.moving.high_px] if a.moving else None for a in answers]
    return {
        "state": [LESSON_STATES.get(a.state.value, a.state.value) for a in answers],
        "reason": [a.reason for a in answers],
        "points": [a.num_points for a in answers],
        "moving": [box and [round(v / SIZE[0], 4) for v in box] for box in moving],
        "truth": rounded(truth.translation),
        "place": scattered(
            known, aligned(causal, truth.translation[known], sight.sensor, truth[0]), len(answers)
        ),
        "final": scattered(
            rows,
            aligned(final.world_from_body.translation, truth.translation[rows], sight.sensor, truth[0]),
            len(answers),
        ),
        "loops": [[loop.frame, loop.verdict] for loop in slam.loops],
        "shown": shown.tolist(),
        "pictures": [encoded(images[k]) for k in shown],
    }


def aligned(positions: np.ndarray, truth: np.ndarray, sensor: str, first: Rigid3) -> np.ndarray:
    """Positions in the true world frame: by the pose of the first frame, or by the best similarity if the scale is unknown."""
    if sensor == "rgbd":
        return np.asarray(first.apply(positions))
    if len(positions) < 3 or np.ptp(truth, axis=0).max() < 1e-6 or np.ptp(positions, axis=0).max() < 1e-6:
        return np.asarray(positions + truth[:1])
    return np.asarray(align_points(positions, truth).apply(positions))


def scattered(rows: Any, positions: np.ndarray, count: int) -> list[list[float] | None]:
    """A position for each frame; None if unknown."""
    out: list[list[float] | None] = [None] * count
    for row, position in zip(rows, rounded(positions)):
        out[int(row)] = position
    return out


def rounded(positions: np.ndarray) -> Any:
    """Nested lists, rounded to a millimeter."""
    return np.round(positions, 3).tolist()


def encoded(gray: np.ndarray) -> str:
    """A reduced image as base64 of WebP, as the page shows it."""
    reduced = cv2.resize(gray, SHOWN_SIZE, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".webp", reduced, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    return base64.b64encode(data.tobytes()).decode("ascii")


def without_repeats(runs: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Remove the images of a run if they are the same as those of the first run."""
    first, *others = runs.values()
    for run in others:
        if run["pictures"] == first["pictures"]:
            run["pictures"] = []
    return runs


def kitchen(folder: Path) -> dict[str, Any]:
    """Distances per image between epipole's trajectory and the two ground truths of 7-Scenes' kitchen."""
    with tempfile.TemporaryDirectory(prefix="epipole-kitchen-") as out:
        trajectory = epipole.slam(folder, out, sensor="rgbd").trajectory
    numbers = np.rint(30 * trajectory.timestamp_s).astype(int)
    by_number = {int(row[0]): row[1:4] for row in np.loadtxt(folder / "poses_sfm.txt")}
    sfm = np.array([by_number[n] for n in numbers])
    fusion = np.array([read_pose_matrix(folder / f"frame-{n:06d}.pose.txt").translation for n in numbers])
    ours = trajectory.world_from_body.translation
    pairs = {
        "ours_sfm": (ours, sfm),
        "ours_fusion": (ours, fusion),
        "sfm_fusion": (sfm, fusion),
    }
    return {"number": numbers.tolist()} | {
        name: rounded(np.linalg.norm(align_points(a, b, with_scale=False).apply(a) - b, axis=1))
        for name, (a, b) in pairs.items()
    }


def main() -> None:
    """Run SLAM, print a line for each run, and write the record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", help="failures to record again, or kitchen (default: all)")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    record = json.loads(RECORD.read_text()) if RECORD.is_file() else {}
    console = Console(width=140)
    for name, runs in failures().items():
        if arguments.only and name not in arguments.only:
            continue
        record[name] = without_repeats({run: recorded(sight) for run, sight in runs.items()})
        for run, frames in record[name].items():
            states = {state: frames["state"].count(state) for state in dict.fromkeys(frames["state"])}
            final = [(p, t) for p, t in zip(frames["final"], frames["truth"]) if p]
            errors = [np.linalg.norm(np.subtract(p, t)) for p, t in final] or [np.nan]
            loops = dict(Counter(verdict for _, verdict in frames["loops"]))
            console.print(
                f"{name}, {run}: {states}, loops {loops}, {100 * np.sqrt(np.mean(np.square(errors))):.2f} cm"
            )
    if not arguments.only or "kitchen" in arguments.only:
        record["kitchen"] = kitchen(data / "slam" / "7scenes")
        console.print(
            {
                k: f"{100 * np.sqrt(np.mean(np.square(v))):.2f} cm"
                for k, v in record["kitchen"].items()
                if k != "number"
            }
        )
    RECORD.write_text(json.dumps(record, separators=(",", ":"), allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
