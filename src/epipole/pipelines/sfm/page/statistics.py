"""Statistics of a reconstruction for its report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from epipole.scene import Reconstruction, ViewGraph

LOW_PARALLAX_RAD = np.deg2rad(2.0)
"""Triangulation angle below which depth is poorly determined."""


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """Counts and distributions of one model."""

    num_images: int
    num_registered: int
    num_points: int
    num_observations: int
    error_px: Float64[np.ndarray, " k"]
    """Finite reprojection errors of all observations."""
    track_length: Int64[np.ndarray, " n"]
    angle_rad: Float64[np.ndarray, " n"]
    """Largest triangulation angle of each point; NaN if it has none."""

    @property
    def mean_error_px(self) -> float:
        """Mean reprojection error; NaN without observations."""
        return float(self.error_px.mean()) if len(self.error_px) else float("nan")

    @property
    def mean_track_length(self) -> float:
        """Mean number of observations per point; NaN without points."""
        return float(self.track_length.mean()) if len(self.track_length) else float("nan")

    @property
    def finite_angle_rad(self) -> Float64[np.ndarray, " m"]:
        """Finite triangulation angles."""
        return self.angle_rad[np.isfinite(self.angle_rad)]


def statistics_of(reconstruction: Reconstruction) -> Statistics:
    """Statistics of a model; distributions of an empty one are empty."""
    errors = reconstruction.reprojection_errors_px() if len(reconstruction.tracks.image) else np.zeros(0)
    return Statistics(
        num_images=len(reconstruction.images),
        num_registered=int(reconstruction.is_registered().sum()),
        num_points=len(reconstruction.points),
        num_observations=len(reconstruction.tracks.image),
        error_px=errors[np.isfinite(errors)],
        track_length=np.diff(reconstruction.tracks.offsets).astype(np.int64),
        angle_rad=widest_angles_rad(reconstruction),
    )


def widest_angles_rad(reconstruction: Reconstruction) -> Float64[np.ndarray, " n"]:
    """Largest angle between any two rays of each point's track; NaN for fewer than two rays.

    The angle between unit vectors a, b is 2 atan2(|a - b|, |a + b|), which is accurate for small angles; the pair with
    the smallest cosine is used.
    """
    tracks = reconstruction.tracks
    out = np.full(len(tracks), np.nan)
    if not len(tracks):
        return out
    centers = reconstruction.camera_centers_in_world()[tracks.image]
    rays = centers - reconstruction.points.xyz_in_world[tracks.point_of_observation()]
    with np.errstate(invalid="ignore", divide="ignore"):
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    lengths = np.diff(tracks.offsets)
    for length in np.unique(lengths[lengths >= 2]):
        points = np.flatnonzero(lengths == length)
        step = max(1, 1_000_000 // int(length) ** 2)
        for start in range(0, len(points), step):
            chunk = points[start : start + step]
            out[chunk] = _widest_in_bundles(rays[tracks.offsets[chunk, None] + np.arange(length)])
    return out


def _widest_in_bundles(rays: Float64[np.ndarray, "n l 3"]) -> Float64[np.ndarray, " n"]:
    cosines = rays @ rays.swapaxes(1, 2)
    n, length = rays.shape[:2]
    a, b = np.divmod(np.where(np.isnan(cosines), 2.0, cosines).reshape(n, -1).argmin(axis=1), length)
    first, second = rays[np.arange(n), a], rays[np.arange(n), b]
    difference = np.linalg.norm(first - second, axis=1)
    return 2.0 * np.arctan2(difference, np.linalg.norm(first + second, axis=1))


def num_low_parallax_pairs(view_graph: ViewGraph) -> int:
    """Number of pairs with a small median triangulation angle."""
    angles = view_graph.median_angle_rad
    return int((angles[np.isfinite(angles)] < LOW_PARALLAX_RAD).sum())
