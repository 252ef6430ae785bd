"""Errors of stereo depth against their standard deviations. `python -m benchmarks.stereo_depth`.

Rendered streets have exact depth from 2 to 30 m. On KITTI 06, the reference is the triangulation of features with the true poses.
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
from epipole.io.images.photographs import read_gray
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.depth import depth_of
from epipole.pipelines.stereo.doctor import examine
from epipole.robust import point_covariances, triangulate_points
from epipole.scene import RectifiedRig
from epipole.synthetic.stereo_rooms import stereo_street

STREETS, BINS, NEAR_M, FAR_M = 24, 8, 2.0, 30.0
MAX_ERROR_PX = 1.5
"""Largest reprojection error of an observation in the triangulation."""
WINDOW = 5
"""Frames before and after the current one from which features are triangulated."""
MIN_VIEWS = 5
"""Minimum number of observations of a triangulated feature."""


def range_rows(num_streets: int = STREETS) -> dict[str, dict[str, float]]:
    """For each range, the 68 % quantile of the errors, and the predicted one: the median of Z^2 / (f B) sigma_d."""
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
        known, bins = np.isfinite(error), np.digitize(true, edges) - 1
        for k in range(BINS):
            in_bin = known & (bins == k)
            errors[k].append(error[in_bin])
            sigmas[k].append(found.sigma[in_bin])
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
    """Normalized differences between stereo depth and triangulated depth of features, over all frames.

    KITTI has no standard deviations of its calibration. Rows are off by a third of a pixel, measured by `examine`; columns are
    assumed to be off by the same amount.
    """
    lefts, rights = (sorted((folder / side).iterdir()) for side in ("image_l", "image_r"))
    projections = np.loadtxt(folder / "calib.txt").reshape(2, 3, 4)
    focal, cx, cy = projections[0, 0, 0], projections[0, 0, 2], projections[0, 1, 2]
    rig = RectifiedRig(focal, cx, cy, -projections[1, 0, 3] / focal)
    world_from_cam = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    cam_from_world = Rigid3(world_from_cam[:, :, :3].copy(), world_from_cam[:, :, 3].copy()).inverse()
    height, width = read_gray(lefts[0]).shape
    camera = Camera(CameraModel.PINHOLE, width, height, np.array([focal, focal, cx, cy]))
    features = [detect_features(read_gray(path)) for path in lefts]
    image_pairs = [(read_gray(a), read_gray(b)) for a, b in zip(lefts[::8], rights[::8])]
    offset_px = examine(image_pairs, rig).calibration_error_px
    uncertain_rig = replace(rig, principal_offset_sigma_px=offset_px)
    ratios, ratios_exact_rig, depths = [], [], []
    for frame in range(WINDOW, len(lefts) - WINDOW):
        views = range(frame - WINDOW, frame + WINDOW + 1)
        pixels = np.full((len(views), len(features[frame]), 2), np.nan)
        for k, view in enumerate(views):
            if view == frame:
                pixels[k] = features[frame].pixels
                continue
            pairs = match_descriptors(features[frame].descriptors, features[view].descriptors)
            pixels[k, pairs[:, 0]] = features[view].pixels[pairs[:, 1]]
        enough = np.isfinite(pixels[:, :, 0]).sum(axis=0) >= MIN_VIEWS
        pixels, poses = pixels[:, enough], cam_from_world[list(views)]
        truth = triangulate_points(poses, camera, pixels, max_error_px=MAX_ERROR_PX)
        seen = truth.inlier_mask
        good = truth.success_mask & (seen.sum(axis=0) >= MIN_VIEWS) & seen[WINDOW]
        points = truth.points_in_world[good]
        noise_px = feature_noise_px(poses, camera, pixels[:, good], points, seen[:, good])
        covariance = point_covariances(poses, camera, points, seen[:, good], noise_px)
        pose = cam_from_world[frame]
        triangulated = pose.apply(points)[:, 2]
        axis = pose.rotation[2]
        triangulated_sigma = np.sqrt(np.einsum("i,nij,j->n", axis, covariance, axis))
        found = match_stereo(read_gray(lefts[frame]), read_gray(rights[frame]), StereoConfig())
        with_offset, exact_rig = depth_of(found, uncertain_rig), depth_of(found, rig)
        column, row = np.rint(pixels[WINDOW, good]).astype(int).T
        stereo, stereo_sigma = with_offset.depth[row, column], with_offset.sigma[row, column]
        usable = np.isfinite(stereo) & (
            triangulated_sigma < stereo_sigma
        )  # the reference must be more accurate
        difference = stereo - triangulated
        ratios.append((difference / np.hypot(stereo_sigma, triangulated_sigma))[usable])
        exact_sigma = np.hypot(exact_rig.sigma[row, column], triangulated_sigma)
        ratios_exact_rig.append((difference / exact_sigma)[usable])
        depths.append(triangulated[usable])
    ratio, depth = np.concatenate(ratios), np.concatenate(depths)
    rows = {
        f"all, calibration to {offset_px:.2f} px": _coverage(ratio),
        "all, calibration taken as exact": _coverage(np.concatenate(ratios_exact_rig)),
    }
    for part in np.array_split(np.argsort(depth), 4):
        rows[f"{depth[part].min():.0f} to {depth[part].max():.0f} m"] = _coverage(ratio[part])
    return rows


def feature_noise_px(
    poses: Rigid3, camera: Camera, pixels: np.ndarray, points: np.ndarray, seen: np.ndarray
) -> float:
    """Robust standard deviation of feature coordinates, from the residuals of triangulation and their degrees of freedom."""
    by_view = [
        (camera.project(poses[k].apply(points)) - pixels[k])[seen[k]].ravel() for k in range(len(pixels))
    ]
    residuals = np.concatenate(by_view)
    freedom = 1.0 - 3.0 * len(points) / len(residuals)
    return float(1.4826 * np.median(np.abs(residuals)) / np.sqrt(freedom))


def _coverage(ratio: np.ndarray) -> dict[str, float]:
    """Coverage of normalized errors."""
    return {
        "features": float(len(ratio)),
        "within one sigma %": 100.0 * float((np.abs(ratio) <= 1).mean()),
        "within two %": 100.0 * float((np.abs(ratio) <= 2).mean()),
        "median": float(np.median(ratio)),
    }


def main() -> None:
    """Print both tables and write the results."""
    parser = argparse.ArgumentParser(description="Standard deviations of stereo depth.")
    parser.add_argument("--data", type=Path, help="data folder (default: $EPIPOLE_DATA or ../shared/data)")
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    data = arguments.data or Path(os.environ.get("EPIPOLE_DATA", REPOSITORY.parent / "shared" / "data"))
    streets = range_rows()
    kitti = kitti_rows(data / "slam" / "kitti06_stereo")
    console = Console(width=120)
    console.print(table_of("depth error against range, rendered streets", streets))
    console.print(table_of("KITTI 06: depth against triangulation with the true poses", kitti))
    arguments.results.mkdir(parents=True, exist_ok=True)
    report = {"machine": describe_machine(2), "streets": streets, "kitti06": kitti}
    (arguments.results / "stereo_depth.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
