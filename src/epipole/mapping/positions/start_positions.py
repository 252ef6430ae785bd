"""Positions of cameras from the directions between pairs of them, where a global solution starts.

A pair of images with a known motion gives the depths of its tracks up to the length of its baseline. Two pairs with an image
in common see some of the same tracks, so that the ratio of their depths is that of their baselines (Cui and Tan, ICCV 2015).
Three robust averages follow: the scale of each pair relative to its images, the scale of each image, and the positions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float64, Int32, Int64
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, cg

from epipole._checks import Declared
from epipole.mapping.positions.laplacian import solve_laplacian

TRACKS_PER_PAIR, LEAST_TRACKS = 40, 5
RAY_NOISE, DIRECTION_NOISE = np.deg2rad(0.1), np.deg2rad(0.5)
"""Assumed standard deviations, with those of rotations, in radians."""
DIRECTION_ROUNDS, MAX_CORRECTION_RAD = 4, np.deg2rad(15.0)
SMALLEST_ANGLE = 1e-4
"""Added to the angles between rays, so that parallel ones intersect too."""
LEAST_PARALLAX_RAD = np.deg2rad(0.5)
"""Angle between two rays below which they give no depth."""
DEPTH_ROUNDS, SCALE_ROUNDS = 4, 6
DEPTH_TOLERANCE, MAX_DEPTH_STEPS = 1e-4, 200
DEPTH_SCALE, IMAGE_SCALE, POSITION_SCALE = 0.2, 0.05, 0.05
"""Residuals beyond which a loss is linear: of the logarithms of depths and scales, and of positions relative to the baseline."""


@dataclass(frozen=True, slots=True, eq=False)
class PairDirections(Declared):
    """Unit directions from the center of the first image of a pair to that of the second, in world axes."""

    image1: Int32[np.ndarray, " p"]
    image2: Int32[np.ndarray, " p"]
    direction_in_world: Float64[np.ndarray, "p 3"]

    def __len__(self) -> int:
        return len(self.image1)

    def __repr__(self) -> str:
        return f"PairDirections({len(self)} pairs)"


class StartPositions(NamedTuple):
    """Centers and points in one frame of arbitrary scale; NaN where the pairs determine none."""

    centers: Float64[np.ndarray, "n 3"]
    points: Float64[np.ndarray, "t 3"]


class _Depths(NamedTuple):
    """Logarithms of the depths that pairs give, in units of their baselines: two for each track of a pair."""

    side: np.ndarray
    """(m,) 2 p for the first image of pair p, 2 p + 1 for the second"""
    observation: np.ndarray
    log: np.ndarray
    weight: np.ndarray


def positions_from_pairs(
    num_images: int,
    offsets: Int64[np.ndarray, " t1"],
    image: Int32[np.ndarray, " r"],
    directions_in_world: Float64[np.ndarray, "r 3"],
    pairs: PairDirections,
) -> StartPositions:
    """Positions of the largest group of images that pairs connect.

    Where two pairs of an image have no track in common, the ratio of their baselines is not determined, and arbitrary.

    Args:
        num_images: number of images.
        offsets: observations offsets[t] to offsets[t + 1] are those of point t.
        image: image of each observation.
        directions_in_world: unit direction from the camera to the point.
        pairs: pairs with a known motion.
    """
    seen = _tracks_of_pairs(num_images, offsets, image, directions_in_world, pairs)
    directions = _refined_directions(seen, pairs.direction_in_world)
    depths = _triangulate(seen, directions)
    log_depth, log_scale = _scales_in_images(depths, len(image), len(pairs))
    is_known = np.isfinite(log_scale).all(axis=1)
    i, j = pairs.image1[is_known], pairs.image2[is_known]
    log_scale, direction = log_scale[is_known], directions[is_known]
    edges = sparse.csr_array((np.ones(len(i)), (i, j)), shape=(num_images, num_images))
    _, component = connected_components(edges, directed=False)

    unit = _robust_average(i, j, component, (log_scale[:, 0] - log_scale[:, 1])[:, None], IMAGE_SCALE)[:, 0]
    baseline = np.exp(0.5 * (log_scale[:, 0] + unit[i] + log_scale[:, 1] + unit[j]))
    centers = _robust_average(i, j, component, baseline[:, None] * direction, POSITION_SCALE * baseline)
    largest = np.argmax(np.bincount(component))
    centers[component != largest] = np.nan

    depth = np.exp(log_depth + unit[image])
    return StartPositions(centers, _points(centers, offsets, image, directions_in_world, depth))


class _Rays(NamedTuple):
    """Both rays of the tracks of pairs."""

    pair: np.ndarray
    first: np.ndarray
    """Observation in the first image."""
    second: np.ndarray
    v: np.ndarray
    w: np.ndarray


def _refined_directions(seen: _Rays, directions: np.ndarray) -> np.ndarray:
    """(p, 3) directions b that minimize sum |b . (v x w)|, near the given ones.

    A motion estimated from two images compensates an error of its rotation by one of its translation; the rotations are
    known better here. Iteratively reweighted least squares; b is the eigenvector of the smallest eigenvalue.
    """
    normal, count = np.cross(seen.v, seen.w), len(directions)
    products = normal[:, :, None] * normal[:, None, :]
    refined = directions
    for _ in range(DIRECTION_ROUNDS):
        off = np.abs((refined[seen.pair] * normal).sum(axis=1))
        weight = 1.0 / np.maximum(off, RAY_NOISE)
        entries = [_sums(seen.pair, weight * products[:, a, b], count) for a in range(3) for b in range(3)]
        _, vectors = np.linalg.eigh(np.stack(entries, axis=1).reshape(-1, 3, 3))
        refined = vectors[:, :, 0] * np.sign((vectors[:, :, 0] * directions).sum(axis=1))[:, None]
    is_better = (refined * directions).sum(axis=1) > np.cos(MAX_CORRECTION_RAD)
    return np.where(is_better[:, None], refined, directions)


def _triangulate(seen: _Rays, directions: np.ndarray) -> _Depths:
    """Depths of tracks of each pair, at the points of the two rays that are nearest to each other."""
    pair, v, w, b = seen.pair, seen.v, seen.w, directions[seen.pair]
    cosine = (v * w).sum(axis=1)
    squared_sine = 1.0 - cosine**2
    with np.errstate(divide="ignore", invalid="ignore"):
        along_v, along_w = (b * v).sum(axis=1), (b * w).sum(axis=1)
        depth1 = (along_v - cosine * along_w) / squared_sine
        depth2 = (cosine * along_v - along_w) / squared_sine
        is_good = (squared_sine > np.sin(LEAST_PARALLAX_RAD) ** 2) & (depth1 > 0.0) & (depth2 > 0.0)
        logs = np.log(np.stack([depth1, depth2], axis=1))
        # An error of b changes the angles between it and the rays; one of a ray changes that between the rays.
        variance = RAY_NOISE**2 / squared_sine[:, None] + DIRECTION_NOISE**2 / (
            1.0 - np.stack([along_w, along_v], axis=1) ** 2
        )
    is_good &= (np.bincount(pair[is_good], minlength=len(directions)) >= LEAST_TRACKS)[pair]
    sides = np.stack([2 * pair, 2 * pair + 1], axis=1)[is_good]
    observations = np.stack([seen.first, seen.second], axis=1)[is_good]
    weight = 1.0 / np.maximum(variance[is_good], RAY_NOISE**2)
    return _Depths(sides.ravel(), observations.ravel(), logs[is_good].ravel(), weight.ravel())


def _tracks_of_pairs(
    num_images: int, offsets: np.ndarray, image: np.ndarray, rays: np.ndarray, pairs: PairDirections
) -> _Rays:
    """Tracks that pairs share: the first ones in one arbitrary order, so that pairs with an image in common share them too; at most `TRACKS_PER_PAIR` of each pair."""
    key = pairs.image1.astype(np.int64) * num_images + pairs.image2
    key = np.concatenate([key, pairs.image2.astype(np.int64) * num_images + pairs.image1])
    order = np.argsort(key, kind="stable")
    left = np.repeat(offsets[1:], np.diff(offsets)) - np.arange(len(image)) - 1
    found = [np.zeros((0, 3), np.int64)]
    for distance in range(1, int(np.diff(offsets).max(initial=1)) if len(key) else 0):
        first = np.flatnonzero(left >= distance)
        second = first + distance
        wanted = image[first].astype(np.int64) * num_images + image[second]
        at = np.minimum(np.searchsorted(key, wanted, sorter=order), len(key) - 1)
        is_pair = key[order[at]] == wanted
        pair, first, second = order[at[is_pair]], first[is_pair], second[is_pair]
        is_reversed = pair >= len(pairs)
        swapped = np.where(is_reversed, second, first), np.where(is_reversed, first, second)
        found.append(np.stack([pair % len(pairs), *swapped], axis=1))
    rows = np.concatenate(found)
    priority = np.random.default_rng(0).permutation(len(offsets) - 1)
    point = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    rows = rows[np.lexsort((priority[point[rows[:, 1]]], rows[:, 0]))]
    start = np.searchsorted(rows[:, 0], np.arange(len(pairs)))
    rows = rows[np.arange(len(rows)) - start[rows[:, 0]] < TRACKS_PER_PAIR]
    pair, first, second = rows.T
    return _Rays(pair, first, second, rays[first], rays[second])


def _scales_in_images(
    depths: _Depths, num_observations: int, num_pairs: int
) -> tuple[np.ndarray, np.ndarray]:
    """Depth of each observation, and baseline of each pair in the units of its first and second image; logarithms.

    Minimizes the sum of w |log(depth in the pair's unit) + log(baseline in the image's unit) - log(depth in the image's unit)|^2,
    robustly. The depths are eliminated; conjugate gradients find the baselines.
    """
    scale, weight = np.zeros(2 * num_pairs), depths.weight
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(DEPTH_ROUNDS):
            scale = _baselines(depths, weight, scale, num_observations)
            depth = _means(depths.observation, depths.log + scale[depths.side], weight, num_observations)
            residual = np.abs(depths.log + scale[depths.side] - depth[depths.observation])
            weight = depths.weight * np.minimum(1.0, DEPTH_SCALE / np.maximum(residual, 1e-12))
    scale[np.bincount(depths.side, minlength=len(scale)) == 0] = np.nan
    return depth, scale.reshape(-1, 2)


def _baselines(depths: _Depths, weight: np.ndarray, start: np.ndarray, num_observations: int) -> np.ndarray:
    """(2 p,) logarithms of the baselines with fixed weights."""
    side, observation = depths.side, depths.observation
    of_side = _sums(side, weight, len(start))

    def without_depths(values: np.ndarray) -> np.ndarray:
        """Weighted sums of what remains of values (m,) when each observation is free."""
        mean = np.nan_to_num(_means(observation, values, weight, num_observations))
        return _sums(side, weight * (values - mean[observation]), len(start))

    system = LinearOperator(
        (len(start), len(start)), matvec=lambda x: without_depths(x[side]), dtype=np.float64
    )
    diagonal = np.where(of_side > 0.0, of_side, 1.0)
    preconditioner = LinearOperator(system.shape, matvec=lambda x: x / diagonal, dtype=np.float64)
    found, _ = cg(
        system,
        -without_depths(depths.log),
        start,
        rtol=DEPTH_TOLERANCE,
        maxiter=MAX_DEPTH_STEPS,
        M=preconditioner,
    )
    return np.asarray(found)


def _sums(group: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    return np.bincount(group, values, count)


def _means(group: np.ndarray, values: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
    """(count,) weighted mean of each group; NaN for empty ones."""
    return np.asarray(np.bincount(group, weight * values, count) / np.bincount(group, weight, count))


def _robust_average(
    first: np.ndarray,
    second: np.ndarray,
    component: np.ndarray,
    differences: np.ndarray,
    scale: np.ndarray | float,
) -> np.ndarray:
    """(n, d) values at the nodes of a graph from differences along its edges, whose noise is proportional to `scale`.

    Iteratively reweighted least squares with a loss that is linear beyond the scale.
    """
    weight = np.broadcast_to(1.0 / np.square(scale), len(first)).astype(np.float64)
    weight /= weight.max(initial=1e-300)
    size, values = np.ones(len(first)), np.zeros((len(component), differences.shape[1]))
    for _ in range(SCALE_ROUNDS):
        values = solve_laplacian(first, second, component, weight / np.maximum(size, 1.0), differences)
        size = np.linalg.norm(values[second] - values[first] - differences, axis=1) / scale
    return values


def _points(
    centers: np.ndarray, offsets: np.ndarray, image: np.ndarray, rays: np.ndarray, depth: np.ndarray
) -> np.ndarray:
    """(t, 3) mean of where the observations of each point see it, those from near counting most; without depths, of their rays."""
    count = len(offsets) - 1
    point = np.repeat(np.arange(count), np.diff(offsets))
    seen_at = centers[image] + depth[:, None] * rays
    is_known = np.isfinite(seen_at).all(axis=1)
    weight = depth[is_known] ** -2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        columns = [_means(point[is_known], x[is_known], weight, count) for x in seen_at.T]
    points = np.stack(columns, axis=1)
    is_missing = np.isnan(points[:, 0])
    points[is_missing] = _nearest_to_rays(centers[image], rays, point, count)[is_missing]
    return points


def _nearest_to_rays(centers: np.ndarray, rays: np.ndarray, point: np.ndarray, count: int) -> np.ndarray:
    """(count, 3) points with the smallest sums of squared distances from their rays (k, 3); NaN if a center is unknown."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    right = np.einsum("kab,kb->ka", across, centers)
    A = np.stack([_sums(point, across[:, a, b], count) for a in range(3) for b in range(3)], axis=1)
    b = np.stack([_sums(point, x, count) for x in right.T], axis=1)
    return np.asarray(
        np.linalg.solve(A.reshape(-1, 3, 3) + SMALLEST_ANGLE**2 * np.eye(3), b[..., None])[..., 0]
    )
