"""Localization of images in finished models, beside COLMAP's absolute pose: `python -m benchmarks.localization`.

- courtyard: 60 rendered images from other viewpoints, in a model of 36, with exact poses.
- kitchen: frames 560 to 648 of a sequence (7-Scenes), in a model of frames 0 to 310, with the published poses.

COLMAP gets the same matches as the first step of epipole, in a separate process. Positions are compared after a similarity that
aligns the cameras of the model with the truth: rotations by orientations, scale and translation by positions. The images of each set are
also localized in the model of the other one, where none belongs.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.tasks.sfm import data_root, matrix_of
from epipole import Localizer, reconstruct
from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.features import detect_features
from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.io.images.photographs import read_gray
from epipole.mapping import refine_pose
from epipole.robust import estimate_absolute_pose
from epipole.synthetic import courtyard, courtyard_views, render
from epipole.synthetic.courtyard import look_at

COURTYARD_IMAGES, QUERIES = 36, 60


@dataclass(frozen=True, slots=True, eq=False)
class LocalizationTask:
    """A model's images and the images to localize, with the true poses of both by name."""

    images: Path
    queries: Path
    camera: Camera
    truth: dict[str, Rigid3]


def courtyard_task(work: Path, _data: Path) -> LocalizationTask:
    """Rendered images around a courtyard; the others are nearer, farther, and look elsewhere."""
    camera = Camera("PINHOLE", 640, 480, [520.0, 520.0, 319.5, 239.5])
    views, rng = courtyard_views(COURTYARD_IMAGES), np.random.default_rng(0)
    truth = {f"m{i:03d}.png": views[i] for i in range(COURTYARD_IMAGES)}
    for i in range(QUERIES):
        center = views.centers()[rng.integers(COURTYARD_IMAGES)] * rng.uniform(0.75, 1.15)
        center = np.abs(center + rng.normal(0, 0.3, 3)) * np.sign(center)
        truth[f"q{i:03d}.png"] = look_at(center, np.array([0.0, 0.0, 1.0]) + rng.normal(0, 0.7, 3))
    for name, pose in truth.items():
        path = work / ("images" if name[0] == "m" else "queries") / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_file():
            cv2.imwrite(str(path), render(courtyard(), camera, pose).rgb[..., ::-1])
    return LocalizationTask(work / "images", work / "queries", camera, truth)


def kitchen_task(work: Path, data: Path) -> LocalizationTask:
    """Links to frames of the sequence."""
    camera = Camera("PINHOLE", 640, 480, [525.5, 525.5, 320.0, 240.0])
    source, truth = data / "slam" / "7scenes", {}
    for row in np.loadtxt(source / "poses_sfm.txt"):
        number = int(row[0])
        path = source / f"frame-{number:06d}.color.jpg"
        is_query = 560 <= number <= 648
        if path.is_file() and (is_query or number <= 310):
            link = work / ("queries" if is_query else "images") / path.name
            link.parent.mkdir(parents=True, exist_ok=True)
            if not link.exists():
                link.symlink_to(path)
            pose = matrix_of(row[1:8])
            truth[path.name] = Rigid3(pose[:, :3], pose[:, 3]).inverse()
    return LocalizationTask(work / "images", work / "queries", camera, truth)


TASKS = {"courtyard": courtyard_task, "kitchen": kitchen_task}


def truth_from_model(names: tuple[str, ...], cams: Rigid3, truth: dict[str, Rigid3]) -> Similarity3:
    """Similarity from the model to the truth."""
    true = [truth[name] for name in names]
    between = np.stack([pose.rotation.T @ cams.rotation[k] for k, pose in enumerate(true)])
    u, _, vt = np.linalg.svd(between.sum(axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    found, wanted = cams.centers() @ rotation.T, np.stack([pose.centers() for pose in true])
    off, wanted_off = found - found.mean(axis=0), wanted - wanted.mean(axis=0)
    scale = float((off * wanted_off).sum() / (off**2).sum())
    return Similarity3(scale, rotation, wanted.mean(axis=0) - scale * found.mean(axis=0))


def errors_of(pose: Rigid3, true: Rigid3, to_truth: Similarity3) -> tuple[float, float]:
    """Distance of the camera center in meters, and angle in degrees."""
    off_m = float(np.linalg.norm(to_truth.apply(pose.centers()[None])[0] - true.centers()))
    rotation = pose.rotation @ np.asarray(to_truth.rotation).T @ true.rotation.T
    return off_m, float(np.degrees(Rotation3(rotation).angle_rad()))


def measure(name: str, work: Path, data: Path) -> dict[str, Any]:
    """Localize every image, and the same matches by COLMAP."""
    task = TASKS[name](work / name, data)
    camera = task.camera
    params = ",".join(str(p) for p in [*camera.params[:2], camera.params[2] + 0.5, camera.params[3] + 0.5])
    out = work / name / "out"
    reconstruct(task.images, out, camera_params=params, camera_model="PINHOLE")
    start = perf_counter()
    localizer = Localizer.open(out)
    open_s = perf_counter() - start
    model = localizer.reference.model
    to_truth = truth_from_model(model.images.name, model.cams_from_world(), task.truth)
    model_mm = [
        1e3 * errors_of(model.cams_from_world()[k], task.truth[n], to_truth)[0]
        for k, n in enumerate(model.images.name)
    ]
    rows, matches, pose_s = [], [], []
    config = RansacConfig(max_error_px=localizer.config.max_error_px)
    paths = sorted(task.queries.iterdir())
    localizer.localize(read_gray(paths[0]), camera)  # compiles
    for path in paths:
        gray = read_gray(path)
        start = perf_counter()
        found = localizer.localize(gray, camera)
        seconds = perf_counter() - start
        off_m, off_deg = (
            errors_of(found.cam_from_world, task.truth[path.name], to_truth)
            if found.success
            else (np.nan, np.nan)
        )
        sigma_m = float(to_truth.scale) * found.position_sigma()
        rows.append((off_m, off_deg, sigma_m, seconds))
        features = detect_features(gray)
        pairs = localizer.match(
            features, localizer.reference.most_similar(features, localizer.config.neighbors)
        )
        pixels, points = features.pixels[pairs.feature].astype(float), model.points.xyz_in_world[pairs.point]
        matches.append((pixels, points))
        start = perf_counter()
        first = estimate_absolute_pose(points, pixels, camera, config)
        refine_pose(points[first.inlier_mask], pixels[first.inlier_mask], camera, first.model)
        pose_s.append(perf_counter() - start)
    off_m, off_deg, sigma_m, seconds = np.array(rows).T
    result = {
        "set": name,
        "images_in_model": len(model.images),
        "model_error_mm": float(np.median(model_mm)),
        "open_s": open_s,
        **_scores("epipole", off_m, off_deg, seconds),
        "epipole_pose_alone_ms": float(1e3 * np.median(pose_s)),
        "within_5_sigma": float(np.mean(off_m < 5.0 * sigma_m)),
        "median_sigma_mm": float(1e3 * np.nanmedian(sigma_m)),
    }
    return result | _by_colmap(task, matches, paths, to_truth, localizer.config.max_error_px, work / name)


def _by_colmap(
    task: LocalizationTask,
    matches: list[tuple[np.ndarray, np.ndarray]],
    paths: list[Path],
    to_truth: Similarity3,
    max_error_px: float,
    work: Path,
) -> dict[str, Any]:
    """The same matches by `pycolmap.estimate_and_refine_absolute_pose`; empty if it is not installed."""
    camera = task.camera
    np.savez(
        work / "matches.npz",
        camera=np.array([camera.width, camera.height, *camera.params]),
        max_error_px=max_error_px,
        offsets=np.cumsum([0, *(len(pixels) for pixels, _ in matches)]),
        pixels=np.concatenate([pixels for pixels, _ in matches]),
        points=np.concatenate([points for _, points in matches]),
    )
    command = [
        sys.executable,
        "-m",
        "benchmarks.peers.pycolmap_pose",
        str(work / "matches.npz"),
        str(work / "poses.npz"),
    ]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"pycolmap": done.stderr.strip().splitlines()[-1:]}
    stored = np.load(work / "poses.npz")
    errors = [
        errors_of(Rigid3(pose[:, :3], pose[:, 3]), task.truth[path.name], to_truth)
        if np.isfinite(pose).all()
        else (np.nan, np.nan)
        for pose, path in zip(stored["poses"], paths)
    ]
    off_m, off_deg = np.array(errors).T
    return _scores("pycolmap", off_m, off_deg, stored["seconds"])


def localize_strangers(task: LocalizationTask, other: Path) -> dict[str, float]:
    """Localize the images of a set in the model of another set, with unknown intrinsics."""
    localizer = Localizer.open(other)
    found = [localizer.localize(read_gray(path)) for path in sorted(task.queries.iterdir())]
    return {
        "images_in_other_model": float(len(found)),
        "localized_in_other_model": float(sum(image.success for image in found)),
        "most_inliers_in_other_model": float(max(image.num_inliers for image in found)),
    }


def _scores(name: str, off_m: np.ndarray, off_deg: np.ndarray, seconds: np.ndarray) -> dict[str, float]:
    known = np.where(np.isfinite(off_m), off_m, np.inf)
    return {
        f"{name}_localized": float(np.isfinite(off_m).mean()),
        f"{name}_median_mm": float(1e3 * np.median(known)),
        f"{name}_95_mm": float(1e3 * np.percentile(known, 95, method="inverted_cdf")),
        f"{name}_median_deg": float(np.nanmedian(off_deg)),
        f"{name}_95_deg": float(np.nanpercentile(off_deg, 95)),
        f"{name}_within_5cm_2deg": float(((known < 0.05) & (off_deg < 2.0)).mean()),
        f"{name}_ms": float(1e3 * np.median(seconds)),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--set", choices=tuple(TASKS), action="append")
    parser.add_argument("--work", type=Path, default=REPOSITORY / "build" / "localization")
    parser.add_argument("--data", type=Path)
    arguments = parser.parse_args()
    names, data = list(arguments.set or TASKS), data_root(arguments.data)
    found = [measure(name, arguments.work, data) for name in names]
    for row, other in zip(found, names[1:] + names[:1]):
        if row["set"] != other:
            task = TASKS[row["set"]](arguments.work / row["set"], data)
            row |= localize_strangers(task, arguments.work / other / "out")
    table = Table("", *(row["set"] for row in found), title="Localization")
    for key in dict.fromkeys(key for row in found for key in row if key != "set"):
        values = [row.get(key, "") for row in found]
        table.add_row(
            key.replace("_", " "), *(f"{v:.3g}" if isinstance(v, float) else str(v) for v in values)
        )
    Console().print(table)
    out = REPOSITORY / "benchmarks" / "results" / "localization.json"
    out.write_text(
        json.dumps({"machine": describe_machine(2), "sets": found}, indent=1) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
