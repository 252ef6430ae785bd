"""Complete the tracks of a model: look for its points in images that should see them.

Matching two images misses many matches: the ratio test compares the whole image. Once points and poses are known, a
point can only appear near its projection, and the descriptor decides among the few features there. Such matches only
extend tracks, because the model that predicts them cannot also be supported by them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sparse
from jaxtyping import UInt8

from epipole import _parallel
from epipole._checks import checked
from epipole.config import MatchConfig
from epipole.features import Features, match_near_pixels
from epipole.mapping.match_components import FurtherMatches
from epipole.mapping.model_builder import ModelBuilder
from epipole.mapping.point_views import PointViews

MIN_SHARED_POINTS = 15
"""Images that observe fewer common points are not neighbors."""


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
    descriptors = _descriptors_of(observed, features)

    def search(start: int, stop: int, _: int) -> list[tuple[np.ndarray, np.ndarray]]:
        scratch, out = observed.scratch(), []
        for image in images[start:stop].tolist():
            row = slice(shared.indptr[image], shared.indptr[image + 1])
            neighbors = np.sort(shared.indices[row][shared.data[row] >= MIN_SHARED_POINTS]).astype(np.int64)
            references = observed.seen_from(model.center[image], neighbors, image, scratch)
            out.append(
                _matches_in(
                    image, model, features[image], observed, references, descriptors, radius_px, config
                )
            )
        return out

    found = _parallel.map_chunks(search, len(images))
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
    model.drop(seen[drop])
    return len(np.unique(point[drop]))


@checked
def median_error_px(model: ModelBuilder) -> float:
    """Median distance between observations and projections of the registered images; NaN without observations."""
    images = np.flatnonzero(model.registered).tolist()

    def errors_of(index: int) -> np.ndarray:
        rows = model.rows_of_image[images[index]]
        rows = rows[model.row_point[rows] >= 0]
        points = model.cam_from_world(images[index]).apply(model.points[model.row_point[rows]])
        pixels = model.camera(int(model.camera_of_image[images[index]])).project(points)
        return np.linalg.norm(pixels - model.row_pixel[rows], axis=1)

    every = np.concatenate([np.zeros(0), *_parallel.map_items(errors_of, len(images))])
    return float(np.nanmedian(every)) if np.isfinite(every).any() else np.nan


def _observations_of(model: ModelBuilder) -> PointViews:
    rows, _ = model.rows_by_point()
    return PointViews.of(
        model.points[: model.num_points],
        model.center,
        model.row_point[rows].astype(np.int32),
        model.row_image[rows].astype(np.int32),
        model.components.keypoint[rows].astype(np.int32),
    )


def _descriptors_of(observed: PointViews, features: Sequence[Features]) -> UInt8[np.ndarray, "k 128"]:
    """The descriptor of each observation; the files of the features are read once."""
    out = np.empty((len(observed.point), 128), np.uint8)

    def load(start: int, stop: int, _: int) -> None:
        for image in range(start, stop):
            rows = observed.rows_of(image)
            if len(rows):
                out[rows] = features[image].descriptors[observed.keypoint[rows]]

    _parallel.map_chunks(load, len(observed.starts) - 1)
    return out


def _matches_in(
    image: int,
    model: ModelBuilder,
    features: Features,
    observed: PointViews,
    references: np.ndarray,
    descriptors: np.ndarray,
    radius_px: float,
    config: MatchConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """(k, 4) rows (image1, keypoint1, image2, keypoint2) with image2 = `image`, and the angles of the descriptors.

    `references` are observations in other images.
    """
    points = model.points[observed.point[references]]
    camera = model.camera(int(model.camera_of_image[image]))
    pixels = camera.project(model.cam_from_world(image).apply(points))
    inside = ((pixels > -0.5) & (pixels < np.array([camera.width, camera.height]) - 0.5)).all(axis=1)
    references, pixels = references[inside], pixels[inside]
    matches, angles = match_near_pixels(pixels, descriptors[references], features, radius_px, config)
    source = references[matches[:, 0]]
    columns = (observed.image[source], observed.keypoint[source], np.full(len(source), image), matches[:, 1])
    return np.stack(columns, axis=1).astype(np.int32), angles
