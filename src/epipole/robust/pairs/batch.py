"""Lists of image pairs in kernel layout; the estimate of one pair is that of a list of one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from epipole._checks import as_points, require_same_length
from epipole.cameras import Camera, CameraModel
from epipole.config import RansacConfig
from epipole.robust._problem_kernels import MODEL_SIZE, MOST_FREEDOM
from epipole.robust.estimate import LARGEST, Found, LoopAnswer, Reason, failed, found_by_loop
from epipole.robust.pairs import _pair_kernels as kernels
from epipole.robust.pairs._wide_pair_kernels import fit_wide_motions
from epipole.robust.rays import is_wide

_NO_CAMERA = Camera(CameraModel.SIMPLE_PINHOLE, 1, 1, np.array([1.0, 0.0, 0.0]))


def pack_pairs(
    pixels: Sequence[tuple[Any, Any]], cameras: Sequence[tuple[Camera, Camera]] | None, seeds: Sequence[int]
) -> kernels.Pairs:
    """Pack matched pixels, (n, 2) each; without cameras for models of pixels alone.

    Raises:
        ShapeError: the two pixel arrays of a pair do not match.
    """
    points = [
        (as_points(pixels1, "pixels1", 2), as_points(pixels2, "pixels2", 2)) for pixels1, pixels2 in pixels
    ]
    lengths = [require_same_length(pixels1=p1, pixels2=p2) for p1, p2 in points]
    both = cameras or [(_NO_CAMERA, _NO_CAMERA)] * len(points)
    different = list({id(camera): camera for pair in both for camera in pair}.values())
    row = {id(camera): k for k, camera in enumerate(different)}
    return kernels.Pairs(
        np.ascontiguousarray(np.concatenate([np.concatenate(side) for side in zip(*points)], axis=1).T),
        np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        np.array([row[id(first)] for first, _ in both], np.int64),
        np.array([row[id(second)] for _, second in both], np.int64),
        np.array([int(c.model) for c in different], np.int64),
        np.stack([c.padded_params() for c in different]),
        np.array([c.focal_px for c in different]),
        np.array([is_wide(c) for c in different], bool),
        np.array([seed % 2**64 for seed in seeds], np.uint64),
    )


def usable_matches(pairs: kernels.Pairs) -> np.ndarray:
    """Mask (m,) of matches with finite numbers that can be squared without overflow."""
    with np.errstate(invalid="ignore"):
        return (np.abs(pairs.pixels) < LARGEST).all(axis=0)


def no_fits(pairs: kernels.Pairs) -> kernels.Fits:
    """Empty fits, to be filled."""
    n = len(pairs.seed)
    return kernels.Fits(
        np.full((n, MODEL_SIZE), np.nan),
        np.full(pairs.pixels.shape[1], np.inf),
        np.zeros((n, 5)),
        np.zeros(n, np.int64),
        np.full(n, np.inf),
        np.zeros((n, MOST_FREEDOM, MOST_FREEDOM)),
    )


def search_for(
    config: RansacConfig, factor: float = 1.0, most: int | None = None, fraction: float | None = None
) -> kernels.Search:
    """The configuration in kernel layout.

    Args:
        config: options of the robust loop.
        factor: multiple of the threshold.
        most: maximum number of samples.
        fraction: smallest useful inlier ratio.
    """
    most = config.max_iterations if most is None else min(most, config.max_iterations)
    return kernels.Search(
        float(factor * config.max_error_px),
        float(config.confidence),
        min(config.min_iterations, most),
        most,
        config.needed_inliers(5, 1),
        float(config.min_inlier_ratio if fraction is None else fraction),
    )


def fit_motions(
    pairs: kernels.Pairs,
    wanted: np.ndarray,
    use: np.ndarray,
    quality: np.ndarray | None,
    search: kernels.Search,
    motions: kernels.Fits,
) -> None:
    """Relative poses of the wanted pairs (p,) on the usable matches (m,); on rays for wide-angle cameras."""
    wide = wanted & (pairs.wide[pairs.camera1] | pairs.wide[pairs.camera2])
    if (wanted & ~wide).any():
        kernels.fit_motions(pairs, wanted & ~wide, use, quality, search, motions)
    if wide.any():
        fit_wide_motions(pairs, wide, use, quality, search, motions)


def to_coordinates(fits: kernels.Fits, p: int) -> tuple[np.ndarray, np.ndarray]:
    """The maps (3, 3) from both images' pixels to the coordinates in which the model of pair p was fitted."""
    u1, v1, u2, v2, s = fits.frame[p]
    t1, t2 = (np.array([[1 / s, 0, -u / s], [0, 1 / s, -v / s], [0, 0, 1]]) for u, v in ((u1, v1), (u2, v2)))
    return t1, t2


def found_of_one(problem: Any, use: np.ndarray, fits: kernels.Fits, config: RansacConfig) -> Found:
    """The result for a list of one pair; `problem` is an instance of the class that was fitted."""
    n, usable = len(use), int(use.sum())
    if usable < problem.sample_size():
        return failed(Reason.TOO_FEW, n, int(problem.degrees_of_freedom()))
    score, iterations = float(fits.best_score[0]), int(fits.iterations[0])
    answer = LoopAnswer(score, iterations, fits.raw[0], fits.residuals_px, fits.information[0])
    return found_by_loop(problem, answer, float(fits.frame[0, 4]), config)
