"""Errors of the estimated scale against its stated standard deviation. `python -m benchmarks.anchors`.

Each trial adjusts a ring of cameras with noisy observations, applies a random similarity, and recovers the scale from one
kind of measurement. The true scale is that of the similarity that best aligns the adjusted cameras with the true ones.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine
from epipole.cameras import Camera
from epipole.config import AnchorOptions
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rotation3, Similarity3, align_points
from epipole.mapping import Freedom, adjust_reconstruction
from epipole.scale import AnchorViews, anchor_model, views_of_model
from epipole.scene import Reconstruction
from epipole.synthetic import SyntheticScene, render
from epipole.synthetic.markers import chessboard_sheet, tag_sheet
from epipole.synthetic.problems import bundle_problem

VIEWS, POINTS, TRACK, NOISE_PX = 36, 400, 8, 0.5
SMALL = (640, 480)
RESULTS = REPOSITORY / "benchmarks" / "results" / "anchors.json"


@dataclass(frozen=True)
class Trial:
    """A model with unknown scale, its ground truth, and a folder for input files."""

    model: Reconstruction
    truth: Reconstruction
    meters: float
    """Meters per unit of the model."""
    rng: np.random.Generator
    folder: Path

    def views(self, image: Callable[[int], np.ndarray | None] = lambda _: None) -> AnchorViews:
        """Views of the model, with images from `image`."""
        return views_of_model(self.model, image)

    def write(self, name: str, lines: list[str]) -> Path:
        """Write the lines to a file of this name and return its path."""
        path = self.folder / name
        path.write_text("\n".join(lines) + "\n")
        return path

    @property
    def centers(self) -> np.ndarray:
        """True camera centers (n, 3)."""
        return self.truth.camera_centers_in_world()


def trial_of(seed: int, folder: Path) -> Trial:
    """An adjusted ring of cameras after a random similarity."""
    rng = np.random.default_rng([7, seed])
    truth = bundle_problem(VIEWS, POINTS, TRACK, NOISE_PX, seed).truth
    frames = replace(truth.frames, timestamp_s=np.arange(VIEWS) * 0.5)
    truth = replace(truth, frames=frames)
    model, _ = adjust_reconstruction(truth, freedom=Freedom(focal=False, distortion=False))
    unit = float(np.exp(rng.uniform(-1.5, 1.5)))
    rotation = Rotation3.exp(rng.normal(size=3)).matrix
    model = model.transformed(Similarity3(np.asarray(unit), rotation, rng.normal(size=3)))
    meters = float(align_points(model.camera_centers_in_world(), truth.camera_centers_in_world()).scale)
    return Trial(model, truth, meters, rng, folder)


def positions(trial: Trial) -> tuple[AnchorViews, AnchorOptions]:
    """Positions of every third image, by name, with 5 cm of noise."""
    rows = np.arange(0, VIEWS, 3)
    positions = trial.centers[rows] + 0.05 * trial.rng.normal(size=(len(rows), 3))
    names = trial.truth.images.name
    path = trial.write("p.txt", [f"{names[i]} {x} {y} {z}" for i, (x, y, z) in zip(rows, positions)])
    return trial.views(), AnchorOptions(positions=path, positions_sigma_m=0.05)


def timed_positions(trial: Trial) -> tuple[AnchorViews, AnchorOptions]:
    """Positions of all images, by time; one in ten is off by meters."""
    positions = trial.centers + 0.05 * trial.rng.normal(size=(VIEWS, 3))
    positions[::10] += 3.0 * trial.rng.normal(size=positions[::10].shape)
    path = trial.write("p.txt", [f"{0.5 * n} {x} {y} {z}" for n, (x, y, z) in enumerate(positions)])
    return trial.views(), AnchorOptions(positions=path, positions_sigma_m=0.05)


def lengths(trial: Trial, count: int = 1) -> tuple[AnchorViews, AnchorOptions]:
    """Lengths in the scene, measured to 2 mm; their ends are clicked in four images with an error of a pixel."""
    camera, lines = trial.truth.cameras[0], []
    cams = trial.truth.cams_from_world()
    for n in range(count):
        ends = trial.rng.uniform(-0.7, 0.7, size=(2, 3))
        while np.linalg.norm(ends[0] - ends[1]) < 0.4:
            ends = trial.rng.uniform(-0.7, 0.7, size=(2, 3))
        length = float(np.linalg.norm(ends[0] - ends[1])) + 0.002 * trial.rng.normal()
        for name, end in zip("ab", ends):
            for i in trial.rng.choice(VIEWS, 4, replace=False):
                x, y = camera.project(cams[i].apply(end[None]))[0] + trial.rng.normal(size=2)
                lines.append(f"L{n} {length:.6f} {name} {trial.truth.images.name[i]} {x:.3f} {y:.3f}")
    return trial.views(), AnchorOptions(lengths=trial.write("l.txt", lines))


def four_lengths(trial: Trial) -> tuple[AnchorViews, AnchorOptions]:
    """Four lengths, one of them 20 % too long in the file."""
    views, options = lengths(trial, 4)
    assert options.lengths is not None
    lines = options.lengths.read_text().splitlines()
    wrong = [line.split() for line in lines if line.startswith("L2 ")]
    others = [line for line in lines if not line.startswith("L2 ")]
    bad = [" ".join([w[0], f"{1.2 * float(w[1]):.6f}", *w[2:]]) for w in wrong]
    return views, AnchorOptions(lengths=trial.write("l.txt", others + bad))


def _facing(trial: Trial) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Axes (right, down, normal) of a sheet, and the rows of the cameras that face it."""
    angle = trial.rng.uniform(0, 2 * np.pi)
    toward = np.array([np.cos(angle), np.sin(angle), 0.0])
    right, down = np.array([-np.sin(angle), np.cos(angle), 0.0]), np.array([0.0, 0.0, -1.0])
    tilt = Rotation3.exp(trial.rng.normal(size=3) * 0.2).matrix
    seen = trial.centers @ toward / np.linalg.norm(trial.centers, axis=1)
    rows = np.flatnonzero(seen > 0.6)
    return tilt @ right, tilt @ down, tilt @ toward, rows


def _sampled(trial: Trial, things: list[Any], rows: np.ndarray) -> AnchorViews:
    """Views with small rendered images of a scene, for the cameras in `rows`."""
    scene = SyntheticScene.of(things, light=(0.3, 0.3, 0.9))
    camera = trial.truth.cameras[0].scaled_to(*SMALL)
    cams = trial.truth.cams_from_world()

    def image(row: int) -> np.ndarray | None:
        if row not in rows:
            return None
        rendered = render(scene, camera, cams[row], noise_sigma=3.0, seed=int(trial.rng.integers(1 << 30)))
        return cv2.cvtColor(rendered.rgb, cv2.COLOR_RGB2GRAY)

    views = trial.views(image)
    cameras: tuple[Camera, ...] = (camera,) * len(views)
    return replace(views, cameras=cameras)


def _vector(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def tags(trial: Trial) -> tuple[AnchorViews, AnchorOptions]:
    """Three AprilTags in rendered images, one printed 10 % too large; the given side has an error of 0.3 %."""
    right, down, _, rows = _facing(trial)
    side, things = 0.25, []
    for n, (offset, size) in enumerate(((-0.5, side), (0.0, side), (0.5, 1.1 * side))):
        things += tag_sheet(7 + n, size, _vector(offset * right), _vector(right), _vector(down))
    stated = side * (1.0 + 0.003 * trial.rng.normal())
    return _sampled(trial, things, rows), AnchorOptions(tag_size_m=stated)


def board(trial: Trial) -> tuple[AnchorViews, AnchorOptions]:
    """A chessboard in rendered images; the given side of its squares has an error of 0.3 %."""
    right, down, _, rows = _facing(trial)
    things = chessboard_sheet(8, 5, 0.1, (0.0, 0.0, 0.0), _vector(right), _vector(down))
    stated = 0.1 * (1.0 + 0.003 * trial.rng.normal())
    return _sampled(trial, things, rows), AnchorOptions(board="8x5", square_m=stated)


def wheels(trial: Trial) -> tuple[AnchorViews, AnchorOptions]:
    """Wheel odometry as distances: a common error of 0.5 %, 2 % of noise per step, and slip in a tenth of the steps."""
    fine = np.linspace(0, VIEWS - 1, 20 * VIEWS)
    angles = 2 * np.pi * fine / VIEWS
    radius = float(np.hypot(*trial.centers[0, :2]))
    trajectory = np.stack(
        [radius * np.cos(angles), radius * np.sin(angles), 0.8 + 0.5 * np.sin(2 * angles)], axis=1
    )
    steps = np.linalg.norm(np.diff(trajectory, axis=0), axis=1)
    steps *= (1.0 + 0.005 * trial.rng.normal()) * (1.0 + 0.02 * trial.rng.normal(size=len(steps)))
    steps[40:110] *= 1.5
    traveled = np.concatenate([[0.0], np.cumsum(steps)])
    lines = [f"{0.5 * t:.6f} {d:.6f}" for t, d in zip(fine, traveled)]
    return trial.views(), AnchorOptions(odometry=trial.write("o.txt", lines), odometry_sigma=0.005)


def wheel_positions(trial: Trial, behind: float = 0.0) -> tuple[AnchorViews, AnchorOptions]:
    """Wheel odometry as a drifting trajectory, with a common error of 0.5 %; `behind`: meters from camera to wheels."""
    positions = trial.truth.cams_from_world().inverse().apply(np.array([0.0, 0.0, -behind]))
    steps = np.diff(positions, axis=0) * (1.0 + 0.005 * trial.rng.normal())
    steps *= 1.0 + 0.02 * trial.rng.normal(size=(len(steps), 1))
    rotations = Rotation3.exp(np.cumsum(0.02 * trial.rng.normal(size=(len(steps), 3)), axis=0))
    positions = np.concatenate([np.zeros((1, 3)), np.cumsum(rotations.apply(steps[:, None])[:, 0], axis=0)])
    lines = [f"{0.5 * n} {x} {y} {z} 0 0 0 1" for n, (x, y, z) in enumerate(positions)]
    options = AnchorOptions(odometry=trial.write("o.txt", lines), odometry_sigma=0.005)
    if not behind:
        return trial.views(), options
    rows = f"[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, {-behind}], [0, 0, 0, 1]]"
    return trial.views(), replace(options, odometry_mounting=trial.write("m.yaml", [f"T_cam_imu: {rows}"]))


def wheels_behind(trial: Trial) -> tuple[AnchorViews, AnchorOptions]:
    """`wheel_positions` with the wheels half a meter behind the camera, which looks inward."""
    return wheel_positions(trial, behind=0.5)


ANCHORS: dict[str, Callable[[Trial], tuple[AnchorViews, AnchorOptions]]] = {
    "positions by name": positions,
    "positions by time, 1 in 10 wrong": timed_positions,
    "one length": lengths,
    "four lengths, one wrong": four_lengths,
    "three tags, one too large": tags,
    "chessboard": board,
    "distances traveled, slip": wheels,
    "positions by odometry": wheel_positions,
    "positions by odometry, 0.5 m behind": wheels_behind,
}

RENDERED = ("three tags, one too large", "chessboard")
"""Anchors that are detected in rendered images."""


def measured(name: str, count: int) -> dict[str, Any]:
    """Errors and stated standard deviations of the scale over the trials, and the trials without a scale."""
    errors, sigmas, refused, start = [], [], [], time.perf_counter()
    for seed in range(count):
        with tempfile.TemporaryDirectory() as folder:
            trial = trial_of(seed, Path(folder))
            views, options = ANCHORS[name](trial)
            try:
                found = anchor_model(views, options).scale
            except DegenerateGeometryError as problem:
                refused.append(str(problem))
                continue
            errors.append(found.scale / trial.meters - 1.0)
            sigmas.append(found.relative_sigma)
    error, sigma = np.array(errors), np.array(sigmas)
    return {
        "trials": count,
        "refused": refused,
        "within 2 sigma %": 100.0 * float((np.abs(error) <= 2.0 * sigma).sum()) / count,
        "within 2 %": 100.0 * float((np.abs(error) <= 0.02).sum()) / count,
        "rms error %": 100.0 * float(np.sqrt((error**2).mean())) if len(error) else None,
        "largest error %": 100.0 * float(np.abs(error).max()) if len(error) else None,
        "median sigma %": 100.0 * float(np.median(sigma)) if len(error) else None,
        "rms error / sigma": float(np.sqrt(((error / sigma) ** 2).mean())) if len(error) else None,
        "seconds": time.perf_counter() - start,
    }


def main() -> None:
    """Run the anchors and print the table."""
    parser = argparse.ArgumentParser(description="Estimated scales against the true scale.")
    parser.add_argument("--anchor", nargs="+", choices=list(ANCHORS), default=list(ANCHORS))
    parser.add_argument(
        "--trials", type=int, default=200, help="trials per anchor; a quarter of them if images are rendered"
    )
    arguments = parser.parse_args()
    report: dict[str, Any] = {"machine": describe_machine(1), "anchors": {}}
    table = Table(title="scale")
    shown = (
        "within 2 sigma %",
        "within 2 %",
        "rms error %",
        "largest error %",
        "median sigma %",
        "rms error / sigma",
    )
    for column in ("anchor", "trials", *shown, "refused"):
        table.add_column(column, justify="left" if column == "anchor" else "right")
    for name in arguments.anchor:
        row = report["anchors"][name] = measured(name, arguments.trials // (4 if name in RENDERED else 1))
        values = ["" if row[key] is None else f"{row[key]:.3g}" for key in shown]
        table.add_row(name, str(row["trials"]), *values, str(len(row["refused"])))
    Console(width=150).print(table)
    if arguments.anchor == list(ANCHORS) and arguments.trials >= 50:
        RESULTS.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
