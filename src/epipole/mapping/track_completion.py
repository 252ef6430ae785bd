"""Complete the tracks of a model: look for its points in images that should see them.

Matching two images misses many matches: the ratio test compares the whole image. Once points and poses are known, a
point can only appear near its projection, and the descriptor decides among the few features there. Such matches only
extend tracks, because the model that predicts them cannot also be supported by them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse

from epipole import _parallel
from epipole._checks import checked
from epipole.config import MatchConfig
from epipole.features import Features, match_near_pixels
from epipole.mapping.match_components import FurtherMatches
from epipole.mapping.model_builder import ModelBuilder

MIN_SHARED_POINTS = 15
"""Images that observe fewer common points are not neighbors."""
MIN_VIEW_COSINE = np.cos(np.deg2rad(40.0))
"""Cosine of the largest angle between two views of a point: beyond it, SIFT descriptors rarely match (Lowe 2004, 7.3)."""


class _Observations(NamedTuple):
    """Observations of a model, sorted by point."""

    point: np.ndarray
    image: np.ndarray
    keypoint: np.ndarray
    to_camera: np.ndarray
    """(k, 3) unit vector from the point to the camera."""


@checked
def find_further_matches(
    model: ModelBuilder, features: Sequence[Features], radius_px: float, config: MatchConfig
) -> FurtherMatches:
    """Match every point with features near its projection in the neighbors of the images that observe it.

    Args:
        model: a model that is adjusted.
        features: SIFT features of each image, in the order of its keypoints.
        radius_px: largest distance between a projection and a feature.
        config: ratio and distance bounds of the descriptors.

    Returns:
        Matches between an observation of the point and the feature, the most similar first.
    """
    images = np.flatnonzero(model.registered)
    observed = _observations_of(model)
    incidence = sparse.csr_array(
        (np.ones(len(observed.point)), (observed.image, observed.point)),
        shape=(len(model.registered), model.num_points),
    )
    shared = (incidence @ incidence.T).tocsr()
    found = _parallel.map_chunks(
        lambda a, b, _: [
            _matches_in(int(i), model, features, observed, shared, radius_px, config) for i in images[a:b]
        ],
        len(images),
    )
    parts = [part for chunk in found for part in chunk]
    table = np.concatenate([rows for rows, _ in parts]) if parts else np.zeros((0, 4), np.int32)
    angles = np.concatenate([angle for _, angle in parts]) if parts else np.zeros(0)
    table = table[np.argsort(angles, kind="stable")]
    return FurtherMatches(*(table[:, c].copy() for c in range(4)))


@checked
def drop_short_tracks(model: ModelBuilder, min_length: int, min_long: int) -> int:
    """Remove points in fewer than `min_length` images whose images all observe `min_long` longer ones; returns their number."""
    seen = np.flatnonzero(model.row_point >= 0)
    point, image = model.row_point[seen], model.row_image[seen]
    is_short = np.bincount(point, minlength=model.num_points)[point] < min_length
    num_long = np.bincount(image[~is_short], minlength=len(model.registered))
    is_needed = np.zeros(model.num_points, bool)
    is_needed[point[num_long[image] < min_long]] = True
    drop = is_short & ~is_needed[point]
    model.row_point[seen[drop]] = -1
    return len(np.unique(point[drop]))


@checked
def median_error_px(model: ModelBuilder) -> float:
    """Median distance between observations and projections of the registered images; NaN without observations."""
    errors = [np.zeros(0)]
    for image in np.flatnonzero(model.registered):
        rows = model.rows_of_image[image]
        rows = rows[model.row_point[rows] >= 0]
        points = model.cam_from_world(int(image)).apply(model.points[model.row_point[rows]])
        pixels = model.camera(int(model.camera_of_image[image])).project(points)
        errors.append(np.linalg.norm(pixels - model.row_pixel[rows], axis=1))
    every = np.concatenate(errors)
    return float(np.nanmedian(every)) if np.isfinite(every).any() else np.nan


def _observations_of(model: ModelBuilder) -> _Observations:
    rows, _ = model.rows_by_point()
    point, image = model.row_point[rows], model.row_image[rows]
    away = model.center[image] - model.points[point]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)
    return _Observations(point, image, model.components.keypoint[rows], away)


def _matches_in(
    image: int,
    model: ModelBuilder,
    features: Sequence[Features],
    observed: _Observations,
    shared: sparse.csr_array,
    radius_px: float,
    config: MatchConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """(k, 4) rows (image1, keypoint1, image2, keypoint2) with image2 = `image`, and the angles of the descriptors."""
    row = slice(shared.indptr[image], shared.indptr[image + 1])
    neighbors = shared.indices[row][shared.data[row] >= MIN_SHARED_POINTS]
    is_neighbor, is_seen = np.zeros(len(model.registered), bool), np.zeros(model.num_points, bool)
    is_neighbor[neighbors] = True
    is_seen[observed.point[observed.image == image]] = True
    near = np.flatnonzero(is_neighbor[observed.image] & ~is_seen[observed.point])
    references = _closest_views(near, observed, model, image)
    points = model.points[observed.point[references]]
    camera = model.camera(int(model.camera_of_image[image]))
    pixels = camera.project(model.cam_from_world(image).apply(points))
    inside = ((pixels > -0.5) & (pixels < np.array([camera.width, camera.height]) - 0.5)).all(axis=1)
    references, pixels = references[inside], pixels[inside]
    descriptors = np.empty((len(references), 128), np.uint8)
    for other in np.unique(observed.image[references]):
        own = observed.image[references] == other
        descriptors[own] = features[other].descriptors[observed.keypoint[references[own]]]
    matches, angles = match_near_pixels(pixels, descriptors, features[image], radius_px, config)
    source = references[matches[:, 0]]
    columns = (observed.image[source], observed.keypoint[source], np.full(len(source), image), matches[:, 1])
    return np.stack(columns, axis=1).astype(np.int32), angles


def _closest_views(near: np.ndarray, observed: _Observations, model: ModelBuilder, image: int) -> np.ndarray:
    """For each point of the observations `near`, sorted by point, the one whose direction is closest to that of `image`."""
    point = observed.point[near]
    starts = np.flatnonzero(np.diff(point, prepend=-1))
    if not len(starts):
        return near
    away = model.center[image] - model.points[point[starts]]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)
    counts = np.diff(np.append(starts, len(near)))
    cosine = np.einsum("ka,ka->k", np.repeat(away, counts, axis=0), observed.to_camera[near])
    largest = np.maximum.reduceat(cosine, starts)
    row = np.where(cosine == np.repeat(largest, counts), np.arange(len(near)), len(near))
    best = np.minimum.reduceat(row, starts)  # the first one that is closest
    return np.asarray(near[best[largest >= MIN_VIEW_COSINE]])
