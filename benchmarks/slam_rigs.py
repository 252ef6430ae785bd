"""SLAM with rigs of cameras, with and without a common view. `python -m benchmarks.slam_rigs`.

Rendered rigs on one round through a furnished room of 6 x 5 m, 320 x 240 pixels per camera; for overlapping rigs, also with the first
camera covered from half way on, and with each pair of adjacent cameras alone. Results: `results/slam_rigs.json`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from epipole._parallel import num_threads
from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3
from epipole.geometry.alignment import align_points
from epipole.metrics import absolute_error
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.slam import Slam
from epipole.scene import CameraRig
from epipole.synthetic import render
from epipole.synthetic.rides import loop_room

NUM_FRAMES, STEP, RATE_HZ = 120, 3, 10.0
SIZE = (320, 240)
PINHOLE = Camera("PINHOLE", *SIZE, [200.0, 200.0, 159.5, 119.5])
FISHEYE = Camera("OPENCV_FISHEYE", *SIZE, [120.0, 120.0, 159.5, 119.5, 0.02, 0.0, 0.0, 0.0])
LEAST_POSES = 10
Images = list[list[np.ndarray]]


def ring(camera: Camera, count: int, radius_m: float = 0.15, start_deg: float = 0.0) -> CameraRig:
    """Cameras on a circle that look outward."""
    yaws = np.radians(start_deg + 360.0 / count * np.arange(count))
    return mounted([camera] * count, yaws, radius_m * np.stack([np.sin(yaws), np.cos(yaws)], axis=1))


def mounted(cameras: list[Camera], yaws: np.ndarray, at: np.ndarray) -> CameraRig:
    """Cameras that look to these sides, at positions (x right, z ahead) in meters."""
    rotations = np.stack([Rotation3.exp(np.array([0.0, yaw, 0.0])).matrix.T for yaw in yaws])
    centers = np.column_stack([at[:, 0], np.zeros(len(at)), at[:, 1]])
    return CameraRig(tuple(cameras), Rigid3(rotations, -np.einsum("kij,kj->ki", rotations, centers)))


RIGS = {
    "2, side by side": mounted([PINHOLE] * 2, np.zeros(2), np.array([[0.0, 0.0], [0.12, 0.0]])),
    "2, 50 degrees apart": mounted(
        [PINHOLE] * 2, np.radians([-25.0, 25.0]), np.array([[-0.1, 0.0], [0.1, 0.0]])
    ),
    "4 fisheye, all around": ring(FISHEYE, 4),
    "6, all around": ring(PINHOLE, 6),
    "2, ahead and to the side, nothing in common": mounted(
        [PINHOLE] * 2, np.radians([0.0, 100.0]), np.array([[0.0, 0.1], [0.25, -0.1]])
    ),
    "4, nothing in common": ring(PINHOLE, 4, 0.1),
}


def main() -> None:
    """Run all rigs, print the table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", nargs="+", choices=tuple(RIGS), default=list(RIGS))
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    rows = [row for name in arguments.rig for row in rows_of(name)]
    table = Table(
        "rig", "localized", "final, mm", "causal, mm", "scale, %", "error / sigma", "ms, median", "95 %"
    )
    for row in rows:
        table.add_row(
            row["rig"], f"{row['localized']} of {NUM_FRAMES}", f"{row['final_mm']:.1f}", _rounded(row["causal_mm"]),
            f"{row['scale_percent']:+.2f}", f"{row['error_over_sigma']:.2f}", f"{row['median_ms']:.0f}", f"{row['ms_95']:.0f}",
        )  # fmt: skip
    Console().print(table)
    content = {"machine": describe_machine(num_threads()), "rows": rows}
    (arguments.results / "slam_rigs.json").write_text(json.dumps(content, indent=1) + "\n")


def rows_of(name: str) -> list[dict[str, Any]]:
    """The rig; if its cameras have a common view also with a covered camera, and all pairs of adjacent cameras."""
    rig, ride = RIGS[name], loop_room(NUM_FRAMES * STEP, SIZE)
    poses = ride.world_from_camera.inverse()
    images: Images = []
    for n in track(range(NUM_FRAMES), f"Rendering {name}"):
        scene, own = ride.scene_at(float(ride.timestamp_s[STEP * n])), poses[STEP * n]
        images.append(
            [_image(scene, camera, rig.cam_from_rig[k] @ own, n) for k, camera in enumerate(rig.cameras)]
        )
    truth = poses[np.arange(0, NUM_FRAMES * STEP, STEP)].inverse()
    rows = [measured(name, rig, images, truth)]
    count = len(rig.cameras)
    if not rig.measures_depth:
        return rows
    covered = [
        [np.zeros_like(row[0]), *row[1:]] if n >= NUM_FRAMES // 2 else row for n, row in enumerate(images)
    ]
    rows.append(measured(f"{name}; one camera covered half way", rig, covered, truth))
    for k in range(count if count > 2 else 0):
        pair = [k, (k + 1) % count]
        mounting = Rigid3(rig.cam_from_rig.rotation[pair], rig.cam_from_rig.translation[pair])
        alone = CameraRig(tuple(rig.cameras[j] for j in pair), mounting)
        few = [[row[j] for j in pair] for row in images]
        rows.append(measured(f"{name}; cameras {pair[0]} and {pair[1]} alone", alone, few, truth))
    return rows


def measured(name: str, rig: CameraRig, images: Images, truth: Rigid3) -> dict[str, Any]:
    """Errors and times of one run."""
    system, seconds, answers = Slam(SlamCamera.of_cameras(rig)), [], []
    for n, row in enumerate(track(images, name)):
        frame = Frame.from_rig(n / RATE_HZ, row, rig)
        start = time.perf_counter()
        answers.append(system.track(frame))
        seconds.append(time.perf_counter() - start)
    rows = [n for n, answer in enumerate(answers) if answer.world_from_body is not None]
    found = [answers[n].world_from_body for n in rows]
    causal = Rigid3(
        np.stack([p.rotation for p in found if p is not None]),
        np.stack([p.translation for p in found if p is not None]),
    )
    system.finish()
    path = system.trajectory()
    numbers = np.rint(RATE_HZ * path.timestamp_s).astype(int)
    final, true = path.world_from_body, truth[numbers]
    alignment = align_points(final.translation, true.translation, with_scale=True)
    # The covariance refers to the world, which is the rig at the first frame with a pose.
    in_world = true[0].inverse() @ true
    off = np.linalg.norm(final.translation - in_world.translation, axis=1)
    assert path.covariance is not None
    sigma = np.sqrt(np.trace(path.covariance[:, :3, :3], axis1=1, axis2=2))
    usual = np.array(seconds[20:])
    return {
        "rig": name,
        "localized": len(path),
        "final_mm": 1e3 * absolute_error(final, true, "rigid").position.rmse,
        "causal": len(rows),
        "causal_mm": _error_mm(causal, truth[np.array(rows)]),
        "scale_percent": 100.0 * (1.0 / float(alignment.scale) - 1.0),
        "error_over_sigma": float(np.median(off[5:] / sigma[5:])),
        "median_ms": 1e3 * float(np.median(usual)),
        "ms_95": 1e3 * float(np.percentile(usual, 95)),
    }


def _error_mm(estimate: Rigid3, truth: Rigid3) -> float | None:
    """Root mean square error after alignment; None if a new map started at once, so that there are few poses."""
    if len(estimate) < LEAST_POSES:
        return None
    return 1e3 * absolute_error(estimate, truth, "rigid").position.rmse


def _rounded(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _image(scene: Any, camera: Camera, cam_from_world: Rigid3, seed: int) -> np.ndarray:
    rgb = render(scene, camera, cam_from_world, noise_sigma=2.0, seed=seed).rgb
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))


if __name__ == "__main__":
    main()
