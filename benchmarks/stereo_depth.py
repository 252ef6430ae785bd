"""Does depth's error bar hold in metres? `python -m benchmarks.stereo_depth`.

Rendered streets with a rig of 800 px and 0.12 m: measured error of depth from 2 to 30 m against Z^2 / (f B) sigma_d.
KITTI 06: depth of features against their triangulation from the truth's poses, in joint standard deviations. Its calibration
comes without errors, and its rows are off by a third of a pixel: what the doctor makes of the rows is taken for the columns too.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.side_by_side import table_of
from epipole.cameras import Camera, CameraModel
from epipole.disparity_search.search import match_stereo
from epipole.features import detect_features, match_descriptors
from epipole.geometry import Rigid3
from epipole.io.images.photographs import read_grey
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.depth import depth_of
from epipole.pipelines.stereo.doctor import examine
from epipole.robust import point_covariances, triangulate_points
from epipole.scene import RectifiedRig
from epipole.synthetic.stereo_rooms import stereo_street

STREETS, BINS, NEAR_M, FAR_M = 24, 8, 2.0, 30.0
MOST_ERROR_PX = 1.5
WINDOW = 5
"""Frames before and after that triangulate a feature."""
LEAST_VIEWS = 5


def range_rows(num_streets: int = STREETS) -> dict[str, dict[str, float]]:
    """Of each range: 68 % of the errors are below `measured`; `predicted` is the median of Z^2 / (f B) sigma_d."""
    edges = np.geomspace(NEAR_M, FAR_M, BINS + 1)
    errors: list[list[np.ndarray]] = [[] for _ in range(BINS)]
    sigmas: list[list[np.ndarray]] = [[] for _ in range(BINS)]
    for seed in range(num_streets):
        pair = stereo_street(seed)
        focal, cx, cy = pair.camera.K[0, 0], pair.camera.K[0, 2], pair.camera.K[1, 2]
        rig = RectifiedRig(focal, cx, cy, pair.baseline)
        found = depth_of(match_stereo(pair.left, pair.right, StereoConfig(max_disparity_px=63)), rig)
        true = focal * pair.baseline / pair.disparity_px
        error = np.abs(found.depth - true)
        known, position = np.isfinite(error), np.digitize(true, edges) - 1
        for k in range(BINS):
            own = known & (position == k)
            errors[k].append(error[own])
            sigmas[k].append(found.sigma[own])
    rows = {}
    for k in range(BINS):
        error, sigma = np.concatenate(errors[k]), np.concatenate(sigmas[k])
        measured, predicted = float(np.quantile(error, 0.68)), float(np.median(sigma))
        rows[f"{edges[k]:.1f} to {edges[k + 1]:.1f} m"] = {
            "measured m": measured,
            "predicted m": predicted,
            "ratio": measured / predicted,
            "within one sigma %": 100.0 * float((error <= sigma).mean()),
        }
    return rows


def kitti_rows(folder: Path) -> dict[str, dict[str, float]]:
    """Normalised differences of stereo depth and triangulated depth of features, over all frames."""
    lefts, rights = (sorted((folder / side).iterdir()) for side in ("image_l", "image_r"))
    projections = np.loadtxt(folder / "calib.txt").reshape(2, 3, 4)
    focal, cx, cy = projections[0, 0, 0], projections[0, 0, 2], projections[0, 1, 2]
    rig = RectifiedRig(focal, cx, cy, -projections[1, 0, 3] / focal)
    world_from_cam = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    cam_from_world = Rigid3(world_from_cam[:, :, :3].copy(), world_from_cam[:, :, 3].copy()).inverse()
    height, width = read_grey(lefts[0]).shape
    camera = Camera(CameraModel.PINHOLE, width, height, np.array([focal, focal, cx, cy]))
    features = [detect_features(read_grey(path)) for path in lefts]
    some = [(read_grey(a), read_grey(b)) for a, b in zip(lefts[::8], rights[::8])]
    offset_px = examine(some, rig).calibration_error_px
    honest = replace(rig, principal_offset_sigma_px=offset_px)
    ratios, naive, depths = [], [], []
    for frame in range(WINDOW, len(lefts) - WINDOW):
        views = range(frame - WINDOW, frame + WINDOW + 1)
        pixels = np.full((len(views), len(features[frame]), 2), np.nan)
        for k, view in enumerate(views):
            if view == frame:
                pixels[k] = features[frame].pixels
                continue
            pairs = match_descriptors(features[frame].descriptors, features[view].descriptors)
            pixels[k, pairs[:, 0]] = features[view].pixels[pairs[:, 1]]
        enough = np.isfinite(pixels[:, :, 0]).sum(axis=0) >= LEAST_VIEWS
        pixels, positions = pixels[:, enough], cam_from_world[list(views)]
        truth = triangulate_points(positions, camera, pixels, max_error_px=MOST_ERROR_PX)
        seen = truth.inlier_mask
        good = truth.success_mask & (seen.sum(axis=0) >= LEAST_VIEWS) & seen[WINDOW]
        points = truth.points_in_world[good]
        noise_px = feature_noise_px(positions, camera, pixels[:, good], points, seen[:, good])
        covariance = point_covariances(positions, camera, points, seen[:, good], noise_px)
        here = cam_from_world[frame]
        triangulated = here.apply(points)[:, 2]
        axis = here.rotation[2]
        their_sigma = np.sqrt(np.einsum("i,nij,j->n", axis, covariance, axis))
        found = match_stereo(read_grey(lefts[frame]), read_grey(rights[frame]), StereoConfig())
        depth, alone = depth_of(found, honest), depth_of(found, rig)
        column, row = np.rint(pixels[WINDOW, good]).astype(int).T
        ours, our_sigma = depth.depth[row, column], depth.sigma[row, column]
        usable = np.isfinite(ours) & (their_sigma < our_sigma)  # else their error is what is measured
        difference = ours - triangulated
        ratios.append((difference / np.hypot(our_sigma, their_sigma))[usable])
        naive.append((difference / np.hypot(alone.sigma[row, column], their_sigma))[usable])
        depths.append(triangulated[usable])
    ratio, depth = np.concatenate(ratios), np.concatenate(depths)
    rows = {
        f"all, calibration to {offset_px:.2f} px": _normalised(ratio),
        "all, calibration taken as exact": _normalised(np.concatenate(naive)),
    }
    for part in np.array_split(np.argsort(depth), 4):
        rows[f"{depth[part].min():.0f} to {depth[part].max():.0f} m"] = _normalised(ratio[part])
    return rows


def feature_noise_px(
    positions: Rigid3, camera: Camera, pixels: np.ndarray, points: np.ndarray, seen: np.ndarray
) -> float:
    """Standard deviation of a feature's coordinate: the median of what triangulation leaves, for the unknowns it had."""
    left = [
        (camera.project(positions[k].apply(points)) - pixels[k])[seen[k]].ravel() for k in range(len(pixels))
    ]
    residuals = np.concatenate(left)
    freedom = 1.0 - 3.0 * len(points) / len(residuals)
    return float(1.4826 * np.median(np.abs(residuals)) / np.sqrt(freedom))


def _normalised(ratio: np.ndarray) -> dict[str, float]:
    return {
        "features": float(len(ratio)),
        "within one sigma %": 100.0 * float((np.abs(ratio) <= 1).mean()),
        "within two %": 100.0 * float((np.abs(ratio) <= 2).mean()),
        "median": float(np.median(ratio)),
    }


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description="Error bars of depth.")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    streets = range_rows()
    kitti = kitti_rows(data / "slam" / "kitti06_stereo")
    console = Console(width=120)
    console.print(table_of("error of depth against range, rendered streets", streets))
    console.print(table_of("KITTI 06: depth against triangulation with the truth's poses", kitti))
    arguments.results.mkdir(parents=True, exist_ok=True)
    report = {"machine": describe_machine(2), "streets": streets, "kitti06": kitti}
    (arguments.results / "stereo_depth.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
