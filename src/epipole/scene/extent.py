"""Extent of a scene for display: a box and a radius that ignore outliers, and camera frusta."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import Declared, checked
from epipole.errors import ConfigError

WIDEST_HALF_ANGLE_RAD = float(np.deg2rad(65.0))
"""Largest angle between a displayed frustum's side and the optical axis."""


@dataclass(frozen=True, slots=True, eq=False)
class Extent(Declared):
    """The part of the world that contains all cameras and nearly all points."""

    low: Float64[np.ndarray, " 3"]
    high: Float64[np.ndarray, " 3"]
    focus: Float64[np.ndarray, " 3"]
    """Point to look at."""
    radius: float
    """Radius of a ball around the focus that contains most points and most cameras."""

    @checked
    def contains(self, points_in_world: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Mask of points inside the box; false for non-finite ones."""
        return np.asarray(((points_in_world >= self.low) & (points_in_world <= self.high)).all(axis=1))

    def __repr__(self) -> str:
        low, high, focus = (np.array2string(v, precision=4) for v in (self.low, self.high, self.focus))
        return f"Extent(from {low} to {high}, focus {focus}, radius {self.radius:.4g})"


@checked
def extent_of(
    points_in_world: Float64[np.ndarray, "n 3"], centers_in_world: Float64[np.ndarray, "m 3"], percent: float
) -> Extent:
    """A box around all cameras and the middle 98 % of the points, with a margin; the cube of +-1 if empty.

    Args:
        points_in_world: non-finite rows are ignored.
        centers_in_world: camera centers; non-finite rows are ignored.
        percent: percentage of points, and of cameras, within the radius.

    Raises:
        ConfigError: percent is outside 0 to 100.
    """
    if not 0 <= percent <= 100:
        raise ConfigError(f"percent must be from 0 to 100, got {percent}")
    points, centers = _finite_rows(points_in_world), _finite_rows(centers_in_world)
    if not len(centers) and not len(points):
        return Extent(-np.ones(3), np.ones(3), np.zeros(3), 1.0)
    bulk = np.percentile(points, (1, 99), axis=0) if len(points) else centers[:1]
    corners = np.concatenate([bulk, centers])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.25 * float((high - low).max()) or 1.0
    focus = np.median(points, axis=0) if len(points) else centers.mean(axis=0)
    radius = max(_reach(points, focus, percent), _reach(centers, focus, percent)) or 1.0
    return Extent(low - margin, high + margin, focus, radius)


def _reach(points: Float64[np.ndarray, "n 3"], focus: Float64[np.ndarray, " 3"], percent: float) -> float:
    return float(np.percentile(np.linalg.norm(points - focus, axis=1), percent)) if len(points) else 0.0


def _finite_rows(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "m 3"]:
    return points[np.isfinite(points).all(axis=1)]


@checked
def frustum_size(centers_in_world: Float64[np.ndarray, "n 3"], least: float, most: float) -> float:
    """Size at which to display frusta: half the median gap between neighbors, within bounds; `most` for fewer than two."""
    if len(centers_in_world) < 2:
        return most
    sample = centers_in_world[:: max(1, len(centers_in_world) // 500)]
    gaps = np.linalg.norm(sample[:, None] - sample, axis=2)
    np.fill_diagonal(gaps, np.inf)
    return float(np.clip(0.5 * np.median(gaps.min(axis=1)), least, most))


@checked
def frustum_corners_in_cam(
    K: Float64[np.ndarray, "3 3"], width: int, height: int
) -> Float64[np.ndarray, "4 3"]:
    """The image's corners, clockwise from the top-left, at depth 1 and without distortion."""
    widest = np.tan(WIDEST_HALF_ANGLE_RAD)
    x = np.clip((np.array([-0.5, width - 0.5]) - K[0, 2]) / K[0, 0], -widest, widest)
    y = np.clip((np.array([-0.5, height - 0.5]) - K[1, 2]) / K[1, 1], -widest, widest)
    return np.array([[x[0], y[0], 1], [x[1], y[0], 1], [x[1], y[1], 1], [x[0], y[1], 1]], float)
