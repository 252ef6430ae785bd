"""Selection of the source views of each view, by the points that they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csr_array

from epipole._checks import Declared, check_count, check_fields, checked
from epipole.errors import ConfigError, ShapeError

BEST_DEG, SPREAD = 9.0, 0.6
"""Best triangulation angle, and standard deviation of its logarithm in the score."""
MOST_CANDIDATES = 30
"""Views with the most common points, which are scored."""
LEAST_POINTS, LEAST_SCORE = 12, 2.0
"""Fewest common points of a source, and the smallest sum of their scores."""
SAME_SIDE = 0.4
"""Part of the score that a view loses that is on the same side as a chosen one: it has the same occlusions."""
RANGE_QUANTILE, NEAR_MARGIN, FAR_MARGIN = 0.01, 0.3, 0.6
"""Quantile of inverse depths that bounds the range of a view, and the margins relative to the range."""
MOST_FAR = 20.0
"""Largest ratio of the farthest depth to that of the farthest point."""


@dataclass(frozen=True, slots=True, eq=False)
class SharedPoints(Declared):
    """Points of a model, and the views that see them."""

    points_in_world: Float64[np.ndarray, "p 3"]
    view_of_observation: Int64[np.ndarray, " k"]
    point_of_observation: Int64[np.ndarray, " k"]

    def __post_init__(self) -> None:
        """Check the columns.

        Raises:
            ShapeError: a column has the wrong type or shape.
        """
        check_fields(self)
        if len(self.view_of_observation) != len(self.point_of_observation):
            raise ShapeError("view_of_observation and point_of_observation must have the same length")


@checked
def select_sources(
    points: SharedPoints,
    centers_in_world: Float64[np.ndarray, "n 3"],
    focals_px: Float64[np.ndarray, " n"],
    most: int,
) -> list[Int64[np.ndarray, " m"]]:
    """The best sources of each view, best first; none for a view without common points.

    A common point counts by its triangulation angle and by the ratio of resolutions (Goesele et al., ICCV 2007). The views are chosen one
    after the other; points that are covered and directions that are taken count less.

    Args:
        points: the model's points, and which views see them.
        centers_in_world: positions of the views.
        focals_px: focal lengths.
        most: largest number of sources.

    Raises:
        ConfigError: most is less than 1.
    """
    check_most(most)
    n, p = len(centers_in_world), len(points.points_in_world)
    ones = np.ones(len(points.view_of_observation), np.int32)
    seen = csr_array((ones, (points.view_of_observation, points.point_of_observation)), shape=(n, p))
    seen.data[:] = 1
    seen.sum_duplicates()
    shared = (seen @ seen.T).tocsr()
    chosen = []
    for view in range(n):
        part = slice(shared.indptr[view], shared.indptr[view + 1])
        candidates = candidates_of(view, shared.indices[part].astype(np.int64), shared.data[part])
        own = _points_of(seen, view)
        common = [np.isin(own, _points_of(seen, other), assume_unique=True) for other in candidates.tolist()]
        rows = np.array([view, *candidates])
        xyz = points.points_in_world[own]
        best = best_sources(xyz, common, centers_in_world[rows], focals_px[rows], most)
        chosen.append(candidates[best])
    return chosen


def check_most(most: int) -> None:
    """Check the largest number of sources.

    Raises:
        ConfigError: it is less than 1.
    """
    check_count(most, "most")
    if most < 1:
        raise ConfigError(f"most must be at least 1, got {most}")


def candidates_of(view: int, others: np.ndarray, num_common: np.ndarray) -> np.ndarray:
    """The views with the most points in common with a view, most first, from the sorted other views and their numbers of common points."""
    usable = (others != view) & (num_common >= LEAST_POINTS)
    order = np.lexsort((others[usable], -num_common[usable]))[:MOST_CANDIDATES]
    return np.asarray(others[usable][order])


def best_sources(
    xyz: np.ndarray, common: Sequence[np.ndarray], centers: np.ndarray, focals: np.ndarray, most: int
) -> np.ndarray:
    """Candidates with the largest gains, one after the other.

    Args:
        xyz: (n, 3) points that the view sees.
        common: (n,) mask of those that each candidate sees.
        centers: (m + 1, 3) positions of the view and its m candidates.
        focals: their focal lengths.
        most: largest number of sources.
    """
    weights = np.zeros((len(common), len(xyz)))
    for k, mask in enumerate(common):
        weights[k, mask] = _weights(xyz[mask], centers[[0, k + 1]], focals[[0, k + 1]])
    toward = centers[1:] - centers[0]
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
    cover, same, out = np.zeros(len(xyz)), np.zeros(len(common)), list[int]()
    while len(out) < min(most, len(common)):
        gain = (weights / (1.0 + cover)).sum(axis=1) * (1.0 - SAME_SIDE * same)
        gain[out] = -1.0
        best = int(np.argmax(gain))
        if weights[best].sum() < LEAST_SCORE:
            break
        out.append(best)
        cover += weights[best]
        same = np.maximum(same, np.clip(toward @ toward[best], 0.0, 1.0))
    return np.array(out, np.int64)


def _points_of(seen: csr_array, view: int) -> np.ndarray:
    return np.asarray(seen.indices[seen.indptr[view] : seen.indptr[view + 1]])


def _weights(xyz: np.ndarray, centers: np.ndarray, focals: np.ndarray) -> np.ndarray:
    """Score of each common point of two views."""
    rays = xyz[None] - centers[:, None]
    distance = np.maximum(np.linalg.norm(rays, axis=2), 1e-12)
    cosine = (rays[0] * rays[1]).sum(axis=1) / (distance[0] * distance[1])
    angle = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
    off = np.log(np.maximum(angle, 1e-6) / BEST_DEG) / SPREAD
    ratio = (focals[0] / distance[0]) / (focals[1] / distance[1])
    return np.asarray(np.exp(-0.5 * off**2) * np.minimum(ratio, 1.0 / ratio) ** 1.5)


@checked
def depth_range(depths: Float64[np.ndarray, " n"]) -> tuple[float, float] | None:
    """Smallest and largest depth of a view from the depths of its points, with a margin in inverse depth; None if no depth is positive."""
    positive = depths[np.isfinite(depths) & (depths > 0)]
    if not len(positive):
        return None
    low, high = np.quantile(1.0 / positive, [RANGE_QUANTILE, 1.0 - RANGE_QUANTILE])
    spread = max(high - low, 0.2 * high)
    return float(1.0 / (high + NEAR_MARGIN * spread)), float(
        1.0 / max(low - FAR_MARGIN * spread, low / MOST_FAR)
    )
