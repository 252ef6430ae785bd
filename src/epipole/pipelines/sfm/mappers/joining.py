"""Models of the same scene in common coordinates: a similarity through the points that they have in common.

Matches between images of two models join keypoints to tracks that both models triangulate. Each such track is a pair of points,
so a robust similarity needs neither common images nor further matching.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from epipole.config import RansacConfig
from epipole.geometry import Rigid3, Similarity3
from epipole.mapping import ModelBuilder
from epipole.pipelines.sfm.config import MapperConfig
from epipole.robust import estimate_similarity

MIN_COMMON = 15
"""Common points that must agree with a similarity."""
MIN_RATIO = 0.3
"""Fraction of the common points that must agree: wrong matches between models that do not overlap agree by chance only."""
TOLERANCE = 0.02
"""Distance of an inlier, relative to the median distance of the points from the cameras; the adjustment reduces it."""


def join_models(
    model: ModelBuilder, parts: Sequence[Mapping[int, Rigid3]], config: MapperConfig
) -> dict[int, Rigid3]:
    """Poses of the images of all models, by row, in the coordinates of the first one; without models that share too few points.

    The model with the most common points is joined first.

    Args:
        model: keypoints and tracks of all images; it is emptied, but keeps its intrinsics.
        parts: for each model, cam_from_world of its images by row.
        config: thresholds of triangulation.
    """
    out = dict(parts[0])
    joined = _points_of_tracks(model, parts[0], config)
    tolerance = TOLERANCE * _median_depth(joined.points, parts[0])
    waiting = {k: _points_of_tracks(model, parts[k], config) for k in range(1, len(parts))}
    while waiting:
        common = {k: joined.in_common(points) for k, points in waiting.items()}
        order = sorted(waiting, key=lambda k: -len(common[k][0]))
        fits = ((k, _similarity(*common[k], tolerance, config.seed)) for k in order)
        k, target_from_source = next(((k, fit) for k, fit in fits if fit is not None), (-1, None))
        if target_from_source is None:
            break
        joined = joined.with_further(waiting.pop(k), target_from_source)
        for row in (row for row in parts[k] if row not in out):
            out[row] = target_from_source.move_cam_from_source(parts[k][row])
    _empty(model)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class _TrackPoints:
    """Points of some tracks."""

    track: Int64[np.ndarray, " n"]
    """Sorted."""
    points: Float64[np.ndarray, "n 3"]

    def in_common(self, source: _TrackPoints) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) points of the tracks that both have: of the other model, and of this one."""
        _, own, theirs = np.intersect1d(self.track, source.track, assume_unique=True, return_indices=True)
        return source.points[theirs], self.points[own]

    def with_further(self, source: _TrackPoints, self_from_source: Similarity3) -> _TrackPoints:
        """These points, and those of further tracks of another model."""
        is_new = ~np.isin(source.track, self.track, assume_unique=True)
        track = np.concatenate([self.track, source.track[is_new]])
        points = np.concatenate([self.points, self_from_source.apply(source.points[is_new])])
        order = np.argsort(track)
        return _TrackPoints(track[order], points[order])


def _points_of_tracks(model: ModelBuilder, poses: Mapping[int, Rigid3], config: MapperConfig) -> _TrackPoints:
    """The points of the tracks that images with these poses triangulate."""
    _empty(model)
    for row, pose in poses.items():
        model.register(row, pose)
    rows = np.concatenate([np.zeros(0, np.int64), *(model.rows_of_image[row] for row in poses)])
    tracks = np.unique(model.row_component[rows])
    model.triangulate(tracks, config.max_error_px, np.deg2rad(config.min_angle_deg))
    has_point = np.flatnonzero(model.row_point >= 0)
    track, first = np.unique(model.row_component[has_point], return_index=True)
    return _TrackPoints(track.astype(np.int64), model.points[model.row_point[has_point[first]]])


def _empty(model: ModelBuilder) -> None:
    params = model.params.copy()
    model.clear()
    model.set_params(params)


def _median_depth(points: np.ndarray, poses: Mapping[int, Rigid3]) -> float:
    """Median distance of the points from the nearest of a few cameras."""
    if not len(points):
        return 0.0
    some = list(poses.values())[:: max(1, len(poses) // 50)]
    centers = np.array([pose.centers() for pose in some])
    points = points[:: max(1, len(points) // 5000)]
    return float(np.median(np.linalg.norm(points[:, None] - centers, axis=2).min(axis=1)))


def _similarity(source: np.ndarray, target: np.ndarray, tolerance: float, seed: int) -> Similarity3 | None:
    """target_from_source through pairs of points; None if too few agree."""
    if len(source) < MIN_COMMON or not tolerance > 0:
        return None
    config = RansacConfig(
        max_error_px=tolerance, min_inliers=MIN_COMMON, min_inlier_ratio=MIN_RATIO, seed=seed
    )
    found = estimate_similarity(source, target, config)
    return found.model if found.success else None
