"""Robust estimation problems with ground truth: synthetic ones, and hand-clicked or surveyed photographs."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import scipy.io

from epipole.cameras import Camera, CameraModel
from epipole.config import FeatureConfig
from epipole.features import detect_features, match_descriptors
from epipole.geometry import Rigid3
from epipole.io import read_database
from epipole.io.images.photographs import read_gray
from epipole.io.truth import read_truth
from epipole.synthetic.problems import absolute_pose_problem, dominant_plane_problem, two_view_problem

Kind = Literal["relative_pose", "absolute_pose", "fundamental", "homography"]
MIN_MATCHES = 15
"""Image pairs with fewer matches are skipped."""
MISLABELED = ("Brussels", "Dresden", "Leuven1")
"""Pairs of kusvod2 whose files have putative matches of other images; they are matched again."""


@dataclass(frozen=True, slots=True, eq=False)
class EstimationProblem:
    """Input of a program, and ground truth for its score."""

    kind: Kind
    first: np.ndarray
    """Pixels in image 1 (n, 2), or points in the world (n, 3)."""
    second: np.ndarray
    """Pixels in image 2, or pixels of the points; integer coordinates are pixel centers."""
    K: np.ndarray
    """Intrinsic matrix of both cameras."""
    size: tuple[int, int]
    motion: Rigid3 | None = None
    """cam2_from_cam1 (up to scale) or cam_from_world."""
    validation: np.ndarray | None = None
    """True matches (u1, v1, u2, v2), (m, 4)."""
    camera: Literal["PINHOLE", "OPENCV_FISHEYE"] = "PINHOLE"
    """Model of both cameras; the distortion coefficients of a fisheye are zero."""

    @property
    def params(self) -> list[float]:
        """Parameters of the camera model."""
        pinhole = [float(self.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
        return pinhole if self.camera == "PINHOLE" else pinhole + [0.0] * 4


@dataclass(frozen=True, slots=True)
class EstimationLimits:
    """Limits that are the same for every program."""

    max_error_px: float = 2.0
    confidence: float = 0.9999
    min_iterations: int = 100
    max_iterations: int = 10_000


@dataclass(frozen=True, slots=True)
class EstimationTask:
    """A family of problems. `problems(data, count)` makes at least `count` of them."""

    name: str
    kind: Kind
    problems: Callable[[Path, int], list[EstimationProblem]]
    limits: EstimationLimits = EstimationLimits()


def _synthetic_relative(num_matches: int, outliers: float) -> Callable[[Path, int], list[EstimationProblem]]:
    """Two views of general scenes, with one pixel of noise."""

    def make(_data: Path, count: int) -> list[EstimationProblem]:
        out = []
        for seed in range(count):
            p = two_view_problem(num_matches, outliers, 1.0, seed)
            size = (p.camera1.width, p.camera1.height)
            out.append(
                EstimationProblem("relative_pose", p.pixels1, p.pixels2, p.camera1.K, size, p.cam2_from_cam1)
            )
        return out

    return make


def _synthetic_absolute(num_points: int, outliers: float) -> Callable[[Path, int], list[EstimationProblem]]:
    """Cameras with random poses, with one pixel of noise."""

    def make(_data: Path, count: int) -> list[EstimationProblem]:
        out = []
        for seed in range(count):
            p = absolute_pose_problem(num_points, outliers, 1.0, seed)
            size = (p.camera.width, p.camera.height)
            out.append(
                EstimationProblem(
                    "absolute_pose", p.points_in_world, p.pixels, p.camera.K, size, p.cam_from_world
                )
            )
        return out

    return make


def _fisheye(half_deg: float) -> Callable[[Path, int], list[EstimationProblem]]:
    """Two views of an equidistant fisheye camera up to `half_deg` from the axis, with 30 % outliers and one pixel of noise."""

    def make(_data: Path, count: int) -> list[EstimationProblem]:
        K = np.array([[400.0, 0.0, 639.5], [0.0, 400.0, 639.5], [0.0, 0.0, 1.0]])
        camera = Camera(
            CameraModel.OPENCV_FISHEYE, 1280, 1280, np.array([400, 400, 639.5, 639.5, 0, 0, 0, 0.0])
        )
        out = []
        for seed in range(count):
            rng = np.random.default_rng(seed)
            motion = Rigid3.exp(np.concatenate([rng.standard_normal(3), 0.1 * rng.standard_normal(3)]))
            motion = Rigid3(motion.rotation, motion.translation / np.linalg.norm(motion.translation))
            cosine, around = (
                rng.uniform(np.cos(np.radians(half_deg)), 1, 1000),
                rng.uniform(0, 2 * np.pi, 1000),
            )
            sine = np.sqrt(1.0 - cosine**2)
            points = np.stack([sine * np.cos(around), sine * np.sin(around), cosine], axis=1)
            points *= rng.uniform(4.0, 9.0, (1000, 1))
            pixels = [camera.project(x) for x in (points, motion.apply(points))]
            pixels = [x + rng.standard_normal(x.shape) for x in pixels]
            wrong = rng.random(1000) < 0.3
            pixels[1][wrong] = rng.uniform(0, 1280, (int(wrong.sum()), 2))
            seen = np.isfinite(pixels[0]).all(axis=1) & np.isfinite(pixels[1]).all(axis=1)
            one, two = (x[seen] for x in pixels)
            out.append(
                EstimationProblem("relative_pose", one, two, K, (1280, 1280), motion, camera="OPENCV_FISHEYE")
            )
        return out

    return make


def _dominant_plane(
    num_matches: int, outliers: float, fraction: float
) -> Callable[[Path, int], list[EstimationProblem]]:
    """A scene with most points on one plane; the score of F uses the exact matches of the other points."""

    def make(_data: Path, count: int) -> list[EstimationProblem]:
        out = []
        for seed in range(count):
            p = dominant_plane_problem(num_matches, fraction, outliers, 1.0, seed)
            points = p.points_in_cam1[~p.plane_mask]
            exact = np.c_[p.camera1.project(points), p.camera2.project(p.cam2_from_cam1.apply(points))]
            size = (p.camera1.width, p.camera1.height)
            out.append(EstimationProblem("fundamental", p.pixels1, p.pixels2, p.camera1.K, size, None, exact))
        return out

    return make


def _shuffled(pairs: list[EstimationProblem], count: int) -> Iterator[EstimationProblem]:
    """Repeat the pairs with other orders of their matches, so that samplers draw other samples, up to `count` problems."""
    for seed in range(-(-count // len(pairs))):
        for pair in pairs:
            order = np.random.default_rng(seed).permutation(len(pair.first))
            yield replace(pair, first=pair.first[order], second=pair.second[order])


def _clicked(kind: Literal["fundamental", "homography"]) -> Callable[[Path, int], list[EstimationProblem]]:
    """Putative matches, and hand-clicked true ones (kusvod2, homogr: Lebeda, Matas, Chum, BMVC 2012).

    The files also contain the true matches (last column 1), which are excluded.
    """

    def make(data: Path, count: int) -> list[EstimationProblem]:
        pairs = []
        for file in sorted((data / "twoview" / kind).glob("*_pts.txt")):
            name = file.name.removesuffix("_pts.txt")
            clicked = scipy.io.loadmat(file.with_name(f"{name}_vpts.mat"))["validation"]["pts"][0, 0]
            validation = np.ascontiguousarray(clicked[[0, 1, 3, 4]].T)
            if kind == "fundamental" and name in MISLABELED:
                images = [next(file.parent.glob(f"{name}{side}.*")) for side in "AB"]
                first, second = _sift_matches(*images)
            else:
                rows = np.loadtxt(file)
                rows = rows[rows[:, -1] == 0]
                first, second = rows[:, :2].copy(), rows[:, 3:5].copy()
            pairs.append(EstimationProblem(kind, first, second, np.eye(3), (0, 0), None, validation))
        if kind == "homography":
            pairs += [_graf(data / "twoview" / "graf", k) for k in (2, 3)]
        return list(_shuffled(pairs, count))

    return make


def _sift_matches(one: Path, two: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of SIFT matches that pass Lowe's ratio test."""
    features = [detect_features(read_gray(path), FeatureConfig()) for path in (one, two)]
    matches = match_descriptors(features[0].descriptors, features[1].descriptors)
    first, second = (f.pixels[matches[:, side]].astype(np.float64) for side, f in enumerate(features))
    return first, second


def _graf(folder: Path, number: int) -> EstimationProblem:
    """SIFT matches of two views of a painted wall; the ground truth is accurate to a pixel (Mikolajczyk et al., IJCV 2005)."""
    truth = np.loadtxt(folder / f"H1to{number}p")
    height, width = read_gray(folder / "img1.ppm").shape
    grid = np.stack(np.meshgrid(np.arange(40, width, 40.0), np.arange(40, height, 40.0)), axis=-1).reshape(
        -1, 2
    )
    moved = np.c_[grid, np.ones(len(grid))] @ truth.T
    moved = moved[:, :2] / moved[:, 2:]
    inside = ((moved > 0) & (moved < (width, height))).all(axis=1)
    return EstimationProblem(
        "homography",
        *_sift_matches(folder / "img1.ppm", folder / f"img{number}.ppm"),
        np.eye(3),
        (width, height),
        None,
        np.c_[grid, moved][inside],
    )


def _surveyed(name: str) -> Callable[[Path, int], list[EstimationProblem]]:
    """All pairs of a set with surveyed cameras (Strecha et al., CVPR 2008), with the putative matches of `epipole reconstruct`."""

    def make(data: Path, count: int) -> list[EstimationProblem]:
        folder = data / "sfm" / name
        K = np.loadtxt(folder / "images" / "K.txt")
        with tempfile.TemporaryDirectory() as out:
            params = ",".join(str(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
            command = [
                str(Path(sys.executable).with_name("epipole")),
                "reconstruct",
                str(folder / "images"),
                out,
            ]
            known = ["--camera-model", "PINHOLE", "--camera-params", params]
            subprocess.run(command + known, check=True, capture_output=True)
            found = read_database(Path(out) / "database.db")
        K[:2, 2] -= 0.5  # in the file, the image's corner is (0, 0)
        truth = read_truth(folder / "gt_dense_cameras")
        row = {Path(n).stem: k for k, n in enumerate(truth.names)}
        motion = [truth.cams_from_world[row[Path(n).stem]] for n in found.images.name]
        camera = found.cameras[0]
        pairs = []
        for (i, j), matches in found.matches.items():
            if len(matches) < MIN_MATCHES:
                continue
            pixels = [
                found.images.keypoints_of(image)[matches[:, side]].astype(np.float64)
                for side, image in enumerate((i, j))
            ]
            size = (camera.width, camera.height)
            truth_ij = motion[j] @ motion[i].inverse()
            pairs.append(EstimationProblem("relative_pose", *pixels, K, size, truth_ij))
        return list(_shuffled(pairs, count))

    return make


_OUTLIERS = (30, 50, 70)
TASKS = {
    task.name: task
    for task in (
        *(
            EstimationTask(f"relative-{n}-{percent}", "relative_pose", _synthetic_relative(n, percent / 100))
            for n in (500, 2000)
            for percent in _OUTLIERS
        ),
        *(
            EstimationTask(
                f"absolute-1000-{percent}", "absolute_pose", _synthetic_absolute(1000, percent / 100)
            )
            for percent in _OUTLIERS
        ),
        *(
            EstimationTask(
                f"fundamental-plane-{percent}", "fundamental", _dominant_plane(1000, 0.4, percent / 100)
            )
            for percent in (80, 90, 95)
        ),
        *(
            EstimationTask(f"relative-fisheye-{degrees}", "relative_pose", _fisheye(degrees))
            for degrees in (60, 88)
        ),
        EstimationTask("fundamental-clicked", "fundamental", _clicked("fundamental")),
        EstimationTask("homography-clicked", "homography", _clicked("homography")),
        EstimationTask("relative-fountain-P11", "relative_pose", _surveyed("fountain-P11")),
        EstimationTask("relative-Herz-Jesus-P8", "relative_pose", _surveyed("Herz-Jesus-P8")),
    )
}
