"""The model as compact data for the 3D view: quantised points and camera frusta."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from epipole.cameras import Camera
from epipole.scene import Reconstruction

MAX_POINTS = 60_000
_WIDEST_TAN = np.tan(np.deg2rad(65.0))


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """Where to look: the part of the world that holds the cameras and nearly all points."""

    low: Float64[np.ndarray, " 3"]
    high: Float64[np.ndarray, " 3"]
    focus: Float64[np.ndarray, " 3"]
    radius: float

    def contains(self, points_in_world: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Mask of points inside; false for non-finite ones."""
        return np.asarray(((points_in_world >= self.low) & (points_in_world <= self.high)).all(axis=1))


def stage_of(reconstruction: Reconstruction) -> Stage:
    """A box around all cameras and the middle 98 % of the points, with a margin; the unit cube if empty."""
    centers = _finite_rows(reconstruction.camera_centers_in_world())
    points = _finite_rows(reconstruction.points.xyz_in_world)
    if not len(centers) and not len(points):
        return Stage(-np.ones(3), np.ones(3), np.zeros(3), 1.0)
    bulk = np.percentile(points, (1, 99), axis=0) if len(points) else centers[:1]
    corners = np.concatenate([bulk, centers])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.25 * float((high - low).max()) or 1.0
    focus = np.median(points, axis=0) if len(points) else centers.mean(axis=0)
    # The bulk of the points and the bulk of the cameras both fit into the first view.
    radius = max(_bulk_distance(points, focus), _bulk_distance(centers, focus)) or 1.0
    return Stage(low - margin, high + margin, focus, radius)


def _bulk_distance(points: Float64[np.ndarray, "n 3"], focus: Float64[np.ndarray, " 3"]) -> float:
    return float(np.percentile(np.linalg.norm(points - focus, axis=1), 95)) if len(points) else 0.0


def frustum_size(centers: Float64[np.ndarray, "n 3"], radius: float) -> float:
    """Depth at which to draw frusta: half the usual gap between neighbours, bounded by the scene's size."""
    if len(centers) < 2:
        return 0.15 * radius
    sample = centers[:: max(1, len(centers) // 500)]
    gaps = np.linalg.norm(sample[:, None] - sample, axis=2)
    np.fill_diagonal(gaps, np.inf)
    return float(np.clip(0.5 * np.median(gaps.min(axis=1)), 0.02 * radius, 0.15 * radius))


def frustum_corners_in_cam(camera: Camera) -> Float64[np.ndarray, "4 3"]:
    """The picture's corners, clockwise from the top-left, at depth 1 and without distortion."""
    K = camera.K
    x = (np.array([-0.5, camera.width - 0.5]) - K[0, 2]) / K[0, 0]
    y = (np.array([-0.5, camera.height - 0.5]) - K[1, 2]) / K[1, 1]
    x, y = np.clip(x, -_WIDEST_TAN, _WIDEST_TAN), np.clip(y, -_WIDEST_TAN, _WIDEST_TAN)
    return np.array([[x[0], y[0], 1], [x[1], y[0], 1], [x[1], y[1], 1], [x[0], y[1], 1]], float)


def sample_points(reconstruction: Reconstruction, stage: Stage, max_points: int) -> Int64[np.ndarray, " n"]:
    """Rows of points on the stage, at most max_points, drawn evenly at random (always the same ones)."""
    rows = np.flatnonzero(stage.contains(reconstruction.points.xyz_in_world))
    if len(rows) <= max_points:
        return rows
    return np.sort(np.random.default_rng(0).choice(rows, max_points, replace=False))


def space_payload(reconstruction: Reconstruction, max_points: int = MAX_POINTS) -> dict[str, Any]:
    """Points as 16-bit steps inside the stage and bytes of colour; frusta as corners around centres."""
    stage = stage_of(reconstruction)
    rows = sample_points(reconstruction, stage, max_points)
    span = stage.high - stage.low
    steps = np.rint((reconstruction.points.xyz_in_world[rows] - stage.low) / span * 65535.0)
    images = np.flatnonzero(reconstruction.is_registered())
    cams_from_world = reconstruction.cams_from_world()[images]
    centers, camera_of_image = cams_from_world.centers(), reconstruction.camera_of_image[images]
    in_cam = [frustum_corners_in_cam(reconstruction.cameras[c]) for c in range(len(reconstruction.cameras))]
    # Directions from centre to corner in the world: R^T corner.
    corners = [in_cam[c] @ rotation for c, rotation in zip(camera_of_image, cams_from_world.rotation)]
    return {
        "low": _rounded(stage.low),
        "span": _rounded(span),
        "focus": _rounded(stage.focus),
        "radius": stage.radius,
        "size": frustum_size(centers, stage.radius),
        "count": len(rows),
        "xyz": _base64(steps.astype("<u2")),
        "rgb": _base64(reconstruction.points.rgb[rows].astype(np.uint8)),
        "image": images.tolist(),
        "centers": [_rounded(c) for c in centers],
        "corners": [[round(float(v), 4) for v in c.ravel()] for c in corners],
    }


def _finite_rows(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "m 3"]:
    return points[np.isfinite(points).all(axis=1)]


def _rounded(values: Float64[np.ndarray, " n"]) -> list[float]:
    return [float(f"{v:.7g}") for v in values]


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
