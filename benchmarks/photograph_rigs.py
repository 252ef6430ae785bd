"""Photographs of rigs with known and with unknown geometry: `python -m benchmarks.photograph_rigs`.

- pair, four: a pair and four cameras, rendered in a courtyard at 12 instants, with exact geometry.
- kitti06: 51 stereo pairs (KITTI odometry 06), with the published calibration.

Known geometry: the distance between the first and the last instant in meters, and its error in stated standard deviations; for KITTI
the RMS of the positions after a rigid alignment, and after a similarity. Unknown geometry: rotation and position of each camera relative to the reference, where the first
baseline gives the unit, and their errors in stated standard deviations.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.tasks.sfm import data_root
from epipole import Reconstruction, reconstruct
from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3, align_points
from epipole.io.images.photographs import write_jpeg_with_exif
from epipole.synthetic import courtyard, courtyard_views, render

CAMERA = Camera("PINHOLE", 640, 480, [520.0, 520.0, 319.5, 239.5])
NUM_INSTANTS = 12
GEOMETRY = Rigid3(
    np.stack(
        [
            Rotation3.exp(np.array(v)).matrix
            for v in ([0, 0, 0], [0, 0.03, 0.01], [0.1, -0.25, 0], [0, 0.3, 0.05])
        ]
    ),
    np.array([[0.0, 0, 0], [-0.54, 0.01, 0.02], [0.2, 0.3, 0.0], [0.4, -0.1, 0.1]]),
)
KITTI_CAMERA = (707.0912, 707.0912, 602.3873, 183.6104)
KITTI_BASELINE_M = 379.8145 / 707.0912


def render_rig(count: int, folder: Path) -> Rigid3:
    """Render the images of the first `count` cameras, unless they are there; returns the poses of the reference."""
    frames = courtyard_views(36)[np.arange(6, 6 + NUM_INSTANTS)]
    for s in range(count):
        (folder / f"cam{s}").mkdir(parents=True, exist_ok=True)
        for k in range(NUM_INSTANTS):
            path = folder / f"cam{s}" / f"{k:03d}.jpg"
            if not path.is_file():
                image = render(
                    courtyard(), CAMERA, GEOMETRY[s] @ frames[k], noise_sigma=2.0, seed=100 * s + k
                )
                write_jpeg_with_exif(path, image.rgb, quality=95)
    return frames


def rig_file(path: Path, count: int, *, is_known: bool) -> Path:
    """Write the rig of the first cameras, with known intrinsics."""
    fx, fy, cx, cy = CAMERA.params.tolist()
    known = {"camera_model_name": "PINHOLE", "camera_params": [fx, fy, cx + 0.5, cy + 0.5]}
    cameras = []
    for s in range(count):
        entry: dict[str, object] = {"image_prefix": f"cam{s}/", **known}
        if s == 0:
            entry["ref_sensor"] = True
        elif is_known:
            entry["cam_from_rig_rotation"] = Rotation3(GEOMETRY.rotation[s]).as_quat_wxyz().tolist()
            entry["cam_from_rig_translation"] = GEOMETRY.translation[s].tolist()
        cameras.append(entry)
    path.write_text(json.dumps([{"cameras": cameras}]), encoding="utf-8")
    return path


def rendered(count: int, work: Path) -> dict[str, float]:
    """Errors of a rendered rig with known and with unknown geometry."""
    at = work / f"rig_{count}"
    frames = render_rig(count, at / "images")
    found = reconstruct(at / "images", at / "known", rigs=rig_file(at / "known.json", count, is_known=True))
    centers = centers_of(found.model, "cam0/")
    true = frames.centers()
    length = np.linalg.norm(centers[-1] - centers[0]) / np.linalg.norm(true[-1] - true[0]) - 1.0
    sigma = found.summary["anchor"]["relative_sigma"]
    out = {"scale error, %": 100.0 * length, "scale error / sigma": length / sigma}
    unknown = reconstruct(
        at / "images", at / "unknown", rigs=rig_file(at / "unknown.json", count, is_known=False)
    )
    rigs = unknown.summary["rigs"]
    unit = np.linalg.norm(GEOMETRY.translation[1]) / np.linalg.norm(rigs["cam1/"]["cam_from_rig_translation"])
    turn, move = [], []
    for s in range(1, count):
        entry = rigs[f"cam{s}/"]
        rotation = Rotation3.from_quat_wxyz(np.array(entry["cam_from_rig_rotation"])).matrix
        off_deg = np.degrees(np.linalg.norm(Rotation3(rotation @ GEOMETRY.rotation[s].T).log()))
        turn.append((off_deg, off_deg / entry["rotation_sigma_deg"]))
        off = np.linalg.norm(unit * np.array(entry["cam_from_rig_translation"]) - GEOMETRY.translation[s])
        move.append((1000.0 * off, off / (unit * entry["position_sigma"])))
    out |= {
        "rotation, worst, degrees": max(v for v, _ in turn),
        "rotation / sigma, worst": max(v for _, v in turn),
        "position, worst, mm": max(v for v, _ in move),
        "position / sigma, worst": max(v for _, v in move),
    }
    return out


def kitti(work: Path, data: Path) -> dict[str, float]:
    """Position error of the stereo pairs of KITTI 06."""
    at, source = work / "kitti06", data / "slam" / "kitti06_stereo"
    for name, folder in (("left", "image_l"), ("right", "image_r")):
        (at / "images" / name).mkdir(parents=True, exist_ok=True)
        for path in sorted((source / folder).glob("*.png")):
            if not (at / "images" / name / path.name).exists():
                (at / "images" / name / path.name).symlink_to(path)
    known = {"camera_model_name": "PINHOLE", "camera_params": list(KITTI_CAMERA)}
    right = {"cam_from_rig_rotation": [1, 0, 0, 0], "cam_from_rig_translation": [-KITTI_BASELINE_M, 0, 0]}
    cameras = [
        {"image_prefix": "left/", "ref_sensor": True, **known},
        {"image_prefix": "right/", **right, **known},
    ]
    (at / "rig.json").write_text(json.dumps([{"cameras": cameras}]), encoding="utf-8")
    found = reconstruct(at / "images", at / "out", rigs=at / "rig.json")
    centers = centers_of(found.model, "left/")
    true = np.loadtxt(source / "poses.txt").reshape(-1, 3, 4)[: len(centers), :, 3]
    off = align_points(centers, true, with_scale=False).apply(centers) - true
    scaled = align_points(centers, true)
    off_scaled = scaled.apply(centers) - true
    return {
        "scale error, %": 100.0 * (1.0 / float(scaled.scale) - 1.0),
        "scale error / sigma": (1.0 / float(scaled.scale) - 1.0) / found.summary["anchor"]["relative_sigma"],
        "position RMS, cm": 100.0 * float(np.sqrt((off**2).sum(axis=1).mean())),
        "position RMS with the true scale, cm": 100.0 * float(np.sqrt((off_scaled**2).sum(axis=1).mean())),
    }


def centers_of(model: Reconstruction, prefix: str) -> np.ndarray:
    """Camera centers of the images with a prefix, by name."""
    row = {name: k for k, name in enumerate(model.images.name) if name.startswith(prefix)}
    return model.camera_centers_in_world()[[row[name] for name in sorted(row)]]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, default=REPOSITORY / "build" / "photograph_rigs")
    parser.add_argument("--data", type=Path)
    arguments = parser.parse_args()
    rows = {"pair": rendered(2, arguments.work), "four": rendered(4, arguments.work)}
    rows["kitti06"] = kitti(arguments.work, data_root(arguments.data))
    table = Table("", *rows, title="Rigs of cameras")
    for key in dict.fromkeys(key for row in rows.values() for key in row):
        table.add_row(key, *(f"{row[key]:.3g}" if key in row else "" for row in rows.values()))
    Console().print(table)
    out = REPOSITORY / "benchmarks" / "results" / "photograph_rigs.json"
    out.write_text(
        json.dumps({"machine": describe_machine(2), "rigs": rows}, indent=1) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
