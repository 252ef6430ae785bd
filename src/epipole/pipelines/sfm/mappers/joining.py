"""Models of the same scene in common coordinates: a similarity through the points that they have in common.

Matches between images of two models join keypoints to tracks that both models triangulate. Each such track is a pair of points,
so a robust similarity needs neither common images nor further matching.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from epipole.config import RansacConfig
from epipole.geometry import Rigid3, Similarity3
from epipole.mapping import ModelBuilder
from epipole.pipelines.sfm.config import MapperConfig
from epipole.robust import estimate_similarity
from epipole.scene import Reconstruction

MIN_COMMON = 15
"""Common points that must agree with a similarity."""
MIN_RATIO = 0.3
"""Fraction of the common points that must agree: wrong matches between models that do not overlap agree by chance only."""
TOLERANCE = 0.02
"""Distance of an inlier, relative to the median distance of the points from the cameras; the adjustment reduces it."""


def join_models(
    model: ModelBuilder,
    earlier: Sequence[Reconstruction],
    known: Sequence[Mapping[int, int]],
    config: MapperConfig,
) -> dict[int, Rigid3]:
    """Poses of the images of all models, by row, in the coordinates of the first one; without models that share too few points.

    Args:
        model: keypoints and tracks of all images; it is emptied, but keeps its intrinsics.
        earlier: the models.
        known: for each model, row of an image and its row in that model.
        config: thresholds of triangulation.
    """
    own = [one.cams_from_world() for one in earlier]
    out = {row: own[0][before] for row, before in known[0].items()}
    waiting = {
        k: _points_of_tracks(model, {row: own[k][before] for row, before in known[k].items()}, config)
        for k in range(1, len(earlier))
    }
    while waiting:
        target = _points_of_tracks(model, out, config)
        tolerance = TOLERANCE * _median_depth(target, out)
        fits = ((k, _similarity(points, target, tolerance, config.seed)) for k, points in waiting.items())
        k, target_from_source = next(((k, fit) for k, fit in fits if fit is not None), (-1, None))
        if target_from_source is None:
            break
        del waiting[k]
        rows = [row for row in known[k] if row not in out]
        if rows:
            moved = target_from_source.move_cam_from_source(own[k][[known[k][row] for row in rows]])
            out |= {row: moved[n] for n, row in enumerate(rows)}
    _empty(model)
    return out


def _points_of_tracks(model: ModelBuilder, poses: Mapping[int, Rigid3], config: MapperConfig) -> np.ndarray:
    """(components, 3) the point of each track that images with these poses triangulate; NaN for none."""
    _empty(model)
    for row, pose in poses.items():
        model.register(row, pose)
    everything = np.arange(len(model.components))
    model.triangulate(everything, config.max_error_px, np.deg2rad(config.min_angle_deg))
    out = np.full((len(model.components), 3), np.nan)
    has_point = model.row_point >= 0
    out[model.row_component[has_point]] = model.points[model.row_point[has_point]]
    return out


def _empty(model: ModelBuilder) -> None:
    params = model.params.copy()
    model.clear()
    model.set_params(params)


def _median_depth(points: np.ndarray, poses: Mapping[int, Rigid3]) -> float:
    """Median distance of the points from the nearest of a few cameras."""
    known = points[np.isfinite(points).all(axis=1)]
    if not len(known):
        return 0.0
    some = list(poses.values())[:: max(1, len(poses) // 50)]
    centers = np.array([pose.centers() for pose in some])
    known = known[:: max(1, len(known) // 5000)]
    return float(np.median(np.linalg.norm(known[:, None] - centers, axis=2).min(axis=1)))


def _similarity(source: np.ndarray, target: np.ndarray, tolerance: float, seed: int) -> Similarity3 | None:
    """target_from_source through the points that both have; None if too few agree."""
    rows = np.flatnonzero(np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1))
    if len(rows) < MIN_COMMON or not tolerance > 0:
        return None
    config = RansacConfig(
        max_error_px=tolerance, min_inliers=MIN_COMMON, min_inlier_ratio=MIN_RATIO, seed=seed
    )
    found = estimate_similarity(source[rows], target[rows], config)
    return found.model if found.success else None
