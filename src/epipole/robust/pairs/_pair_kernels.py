"""Robust fits of one model to the matches of many pairs.

Matches of pair p are the columns offsets[p] to offsets[p + 1] of `pixels` (rows u1, v1, u2, v2).
"""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import unproject_one
from epipole.robust._loop_kernels import next_random, ransac
from epipole.robust.pairs._fundamental_kernels import FundamentalProblem
from epipole.robust.pairs._homography_kernels import HomographyProblem
from epipole.robust.pairs._relative_pose_kernels import RelativePoseProblem

LEAST_DEPTH = 1e-3  # rays flatter than this do not cross the plane z = 1


class Pairs(NamedTuple):
    """The matches of a list of pairs, and their cameras."""

    pixels: np.ndarray
    """(4, matches)."""
    offsets: np.ndarray
    """(pairs + 1,)."""
    camera1: np.ndarray
    """(pairs,), rows of models and params."""
    camera2: np.ndarray
    models: np.ndarray
    params: np.ndarray
    """(cameras, 12)."""
    focal_px: np.ndarray
    """(cameras,), mean focal lengths."""
    wide: np.ndarray
    """(cameras,), whether the plane z = 1 is unsuitable as an image (wide-angle)."""
    seed: np.ndarray
    """(pairs,), uint64."""


class Search(NamedTuple):
    """Search parameters."""

    max_error_px: float
    confidence: float
    min_iterations: int
    max_iterations: int
    min_inliers: int
    min_fraction: float


class Fits(NamedTuple):
    """Fits of one model to all pairs."""

    raw: np.ndarray
    """(pairs, MODEL_SIZE), in kernel layout, in the coordinates below."""
    residuals_px: np.ndarray
    """(matches,), infinite if ignored."""
    frame: np.ndarray
    """(pairs, 5): coordinates are (pixel - center) / spread; u1, v1, u2, v2 of the centers, and the spread.
    For relative poses, whose coordinates are rays, only the spread is used: the focal length."""
    iterations: np.ndarray
    """(pairs,)"""
    best_score: np.ndarray
    """(pairs,), MSAC score in these coordinates; infinite without a model."""
    information: np.ndarray
    """(pairs, MOST_FREEDOM, MOST_FREEDOM), J^T J of the inliers."""


@kernel
def longest(pairs):
    """Largest number of matches of a pair."""
    most = 0
    for p in range(len(pairs.seed)):
        most = max(most, pairs.offsets[p + 1] - pairs.offsets[p])
    return most


@kernel
def choose(pairs, p, use, chosen):
    """Write the indices of the usable matches of pair p to `chosen`; returns their number."""
    count = 0
    for k in range(pairs.offsets[p], pairs.offsets[p + 1]):
        if use[k]:
            chosen[count] = k
            count += 1
    return count


@kernel(allocates=True)
def shuffle(chosen, count, seed):
    """Shuffle the first `count` numbers."""
    state = np.empty(1, np.uint64)
    state[0] = seed
    for k in range(count - 1, 0, -1):
        other = np.int64(next_random(state) % np.uint64(k + 1))
        chosen[k], chosen[other] = chosen[other], chosen[k]


@kernel
def mean_focal(pairs, p):
    """Harmonic mean of both focal lengths, which converts errors of rays to pixels."""
    return 2.0 / (1.0 / pairs.focal_px[pairs.camera1[p]] + 1.0 / pairs.focal_px[pairs.camera2[p]])


@kernel(fuse=True)
def _onto_plane(pairs, p, k, which, out, column):
    """Intersect the ray of match k with the plane z = 1 of camera `which`; returns whether it does."""
    camera = pairs.camera1[p] if which == 0 else pairs.camera2[p]
    x, y, z = unproject_one(
        np.int64(pairs.models[camera]),
        pairs.params[camera],
        pairs.pixels[2 * which, k],
        pairs.pixels[2 * which + 1, k],
    )
    if not z > LEAST_DEPTH:
        return False
    out[2 * which, column], out[2 * which + 1, column] = x / z, y / z
    return True


@kernel
def keep(pairs, p, chosen, count, residuals, scale, fits):
    """Residuals in the caller's order, in pixels."""
    for k in range(pairs.offsets[p], pairs.offsets[p + 1]):
        fits.residuals_px[k] = math.inf
    for c in range(count):
        fits.residuals_px[chosen[c]] = math.sqrt(residuals[c]) * scale


@kernel
def least_fraction(search, count):
    """Smallest useful inlier ratio."""
    return min(1.0, max(search.min_fraction, search.min_inliers / count))


@kernel(allocates=True)
def _ranking(quality, chosen, count):
    """The chosen matches, best first; None without quality (PROSAC is then not even compiled)."""
    if quality is None:
        return None
    return np.argsort(-quality[chosen[:count]], kind="mergesort")


@kernel(allocates=True)
def search_pair(pairs, p, problem, chosen, quality, search, fits):
    """Fit pair p; the problem's items are its chosen matches in the coordinates of `fits.frame`."""
    count, scale = problem.num_items(), fits.frame[p, 4]
    residuals = np.full(count, math.inf)
    fits.best_score[p], fits.iterations[p] = math.inf, 0
    if count >= problem.sample_size():
        score, iterations = ransac(
            problem,
            (search.max_error_px / scale) ** 2,
            search.confidence,
            search.min_iterations,
            search.max_iterations,
            least_fraction(search, count),
            pairs.seed[p],
            _ranking(quality, chosen, count),
            fits.raw[p],
            residuals,
            fits.information[p],
        )
        fits.best_score[p], fits.iterations[p] = score, iterations
    keep(pairs, p, chosen, count, residuals, scale, fits)


@kernel(allocates=True)
def fit_motions(pairs, wanted, use, quality, search, fits):
    """Relative poses of the wanted pairs on the matches marked in `use`; quality (matches,) or None."""
    most = longest(pairs)
    chosen, items = np.empty(most, np.int64), np.empty((4, most))
    for p in range(len(pairs.seed)):
        if not wanted[p]:
            continue
        count = choose(pairs, p, use, chosen)
        shuffle(chosen, count, pairs.seed[p])
        seen = 0
        for c in range(count):
            if _onto_plane(pairs, p, chosen[c], 0, items, seen) and _onto_plane(
                pairs, p, chosen[c], 1, items, seen
            ):
                chosen[seen] = chosen[c]
                seen += 1
        fits.frame[p, 4] = mean_focal(pairs, p)
        problem = RelativePoseProblem(items[:, :seen].copy())
        search_pair(pairs, p, problem, chosen, quality, search, fits)


@kernel
def _normalize(pairs, chosen, count, frame, items):
    """Center the matches of both images and divide by a common length; returns their number, or 0 if they coincide."""
    frame[4] = 1.0
    for r in range(4):
        total = 0.0
        for c in range(count):
            total += pairs.pixels[r, chosen[c]]
        frame[r] = total / count
    spread = 0.0
    for which in range(2):
        total = 0.0
        for c in range(count):
            for r in range(2 * which, 2 * which + 2):
                total += (pairs.pixels[r, chosen[c]] - frame[r]) ** 2
        spread = max(spread, math.sqrt(total / count))
    if not (spread > 1e-9 and spread < math.inf):
        return 0
    frame[4] = spread
    for r in range(4):
        for c in range(count):
            items[r, c] = (pairs.pixels[r, chosen[c]] - frame[r]) / spread
    return count


@kernel
def _normalized(pairs, p, use, chosen, frame, items):
    """The usable matches of pair p, shuffled and normalized; returns their number."""
    count = choose(pairs, p, use, chosen)
    shuffle(chosen, count, pairs.seed[p])
    return _normalize(pairs, chosen, count, frame, items)


@kernel(allocates=True)
def fit_fundamentals(pairs, wanted, use, quality, search, fits):
    """Fundamental matrices of the wanted pairs on the matches marked in `use`."""
    most = longest(pairs)
    chosen, items = np.empty(most, np.int64), np.empty((4, most))
    for p in range(len(pairs.seed)):
        if not wanted[p]:
            continue
        count = _normalized(pairs, p, use, chosen, fits.frame[p], items)
        problem = FundamentalProblem(items[:, :count].copy())
        search_pair(pairs, p, problem, chosen, quality, search, fits)


@kernel(allocates=True)
def fit_homographies(pairs, use, quality, search, fits):
    """Homographies of all pairs on the matches marked in `use`."""
    most = longest(pairs)
    chosen, items = np.empty(most, np.int64), np.empty((4, most))
    for p in range(len(pairs.seed)):
        count = _normalized(pairs, p, use, chosen, fits.frame[p], items)
        problem = HomographyProblem(items[:, :count].copy())
        search_pair(pairs, p, problem, chosen, quality, search, fits)
