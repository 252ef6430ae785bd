"""What the viewer shows and from where: pure functions of arrays."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.scene import Reconstruction

_WIDEST_FOV_RAD = np.deg2rad(130.0)


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """The middle of a scene and the size of what matters in it."""

    focus: Float64[np.ndarray, " 3"]
    radius: float
    frustum_size: float
    """Depth at which to draw camera frusta."""


def visible_points(
    error_px: Float64[np.ndarray, " n"],
    track_length: Int64[np.ndarray, " n"],
    max_error_px: float,
    min_track_length: int,
) -> Bool[np.ndarray, " n"]:
    """Mask of points at most this wrong and seen at least this often; an unknown error (NaN) passes."""
    too_wrong = np.nan_to_num(error_px, nan=0.0) > max_error_px
    return ~too_wrong & (track_length >= min_track_length)


def extent_of(reconstruction: Reconstruction) -> Extent:
    """Focus on the median point; a radius that holds 90 % of the points and of the cameras."""
    points = reconstruction.points.xyz_in_world
    points = points[np.isfinite(points).all(axis=1)]
    centers = reconstruction.camera_centers_in_world()[reconstruction.is_registered()]
    clouds = [cloud for cloud in (points, centers) if len(cloud)]
    if not clouds:
        return Extent(np.zeros(3), 1.0, 0.1)
    focus = np.median(clouds[0], axis=0)
    reach = [float(np.percentile(np.linalg.norm(cloud - focus, axis=1), 90)) for cloud in clouds]
    radius = max(reach) or 1.0
    return Extent(focus, radius, _frustum_size(centers, radius))


def _frustum_size(centers: Float64[np.ndarray, "n 3"], radius: float) -> float:
    """Half the usual gap between neighbours, within bounds of the scene's size."""
    if len(centers) < 2:
        return 0.1 * radius
    sample = centers[:: max(1, len(centers) // 500)]
    gaps = np.linalg.norm(sample[:, None] - sample, axis=2)
    np.fill_diagonal(gaps, np.inf)
    return float(np.clip(0.5 * np.median(gaps.min(axis=1)), 0.01 * radius, 0.08 * radius))


def vertical_fov_rad(camera: Camera) -> float:
    """The angle from the picture's top to its bottom, limited to what a drawn frustum can show."""
    return float(min(2.0 * np.arctan2(0.5 * camera.height, camera.K[1, 1]), _WIDEST_FOV_RAD))


def downscaled(image: UInt8[np.ndarray, "h w 3"], max_side: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The picture with its longer side at most max_side pixels."""
    height, width = image.shape[:2]
    factor = max_side / max(height, width)
    if factor >= 1.0:
        return image
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def glide(world_from_start: Rigid3, world_from_goal: Rigid3, num_steps: int) -> Rigid3:
    """Places from start (excluded) to goal (included) on a screw motion with a gentle start and end."""
    u = np.arange(1, num_steps + 1) / num_steps
    start_from_goal = world_from_start.inverse() @ world_from_goal
    return world_from_start @ Rigid3.exp((u * u * (3.0 - 2.0 * u))[:, None] * start_from_goal.log())
