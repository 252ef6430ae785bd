"""The result type of all robust estimators, and the steps from arrays through the robust loop to it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float64
from scipy.special import gammainc

from epipole._checks import as_float_array
from epipole.config import RansacConfig
from epipole.errors import ShapeError
from epipole.robust import _loop_kernels as loop
from epipole.robust._problem_kernels import MODEL_SIZE, MOST_FREEDOM

Model = TypeVar("Model")

SINGULAR = 1e-11
"""Eigenvalue of the scaled information matrix below which the model is undetermined."""


LARGEST = 1e150
"""Larger numbers count as infinite, as their squares may overflow."""


class Reason(StrEnum):
    """Why an estimate failed, or OK."""

    OK = "ok"
    TOO_FEW = "fewer items than a model needs to be confirmed"
    NO_MODEL = "no sample of the items gave a model"
    TOO_FEW_INLIERS = "too few items agree with any model"
    UNKNOWN_SIGN = "the translation is known up to its sign only: all points are too far away"
    DEGENERATE = "the items do not determine the model (a line, a plane, no motion, repeated items)"


@dataclass(frozen=True, slots=True, eq=False)
class Estimate(Generic[Model]):
    """Result of a robust estimator; failures are reported in it, not raised."""

    model: Model
    """NaN if nothing was found; for a degenerate estimate, one of the models that fit."""
    reason: Reason
    inlier_mask: Bool[np.ndarray, " n"]
    residuals_px: Float64[np.ndarray, " n"]
    """Sampson distance, transfer error or reprojection error, in the unit of the threshold; infinite if undefined."""
    num_iterations: int
    score: float
    """MSAC: the sum of squared residuals, each truncated at the threshold squared; infinite if nothing was found."""
    noise_px: float
    """Standard deviation of one coordinate of the inliers' noise, corrected for truncation at the threshold."""
    covariance: Float64[np.ndarray, "d d"]
    """First-order covariance of the model's parameters (see each estimator); infinite where undetermined."""

    @property
    def success(self) -> bool:
        """Whether the model can be used."""
        return self.reason is Reason.OK

    @property
    def num_inliers(self) -> int:
        """Number of items that agree with the model."""
        return int(self.inlier_mask.sum())

    def __repr__(self) -> str:
        return f"Estimate({self.reason.value}, {self.num_inliers} of {len(self.inlier_mask)} inliers)"


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Result of the loop, before conversion to the public model."""

    reason: Reason
    raw: np.ndarray
    """(MODEL_SIZE,), in kernel layout."""
    residuals: np.ndarray
    """In the caller's order and unit."""
    inlier_mask: np.ndarray
    num_iterations: int
    score: float
    noise: float
    covariance: np.ndarray
    """Of the kernels' own step parameters."""

    def estimate(self, model: Model, covariance: np.ndarray | None = None) -> Estimate[Model]:
        """The public result with this model, and this covariance instead of the kernels'."""
        return Estimate(
            model,
            self.reason,
            self.inlier_mask,
            self.residuals,
            self.num_iterations,
            self.score,
            self.noise,
            self.covariance if covariance is None else covariance,
        )


def usable_rows(*columns: np.ndarray) -> np.ndarray:
    """Items with finite numbers that can be squared without overflow."""
    with np.errstate(invalid="ignore"):
        return np.logical_and.reduce([(np.abs(c) < LARGEST).all(axis=1) for c in columns])


def random_order(usable: np.ndarray, config: RansacConfig) -> np.ndarray:
    """Indices of the usable items, in the order in which the loop tests them."""
    indices = np.flatnonzero(usable)
    return np.random.default_rng(config.seed).permutation(indices)


def checked_quality(quality: Any, n: int) -> np.ndarray | None:
    """One finite number per item, or None.

    Raises:
        ShapeError: wrong shape, or NaN.
    """
    if quality is None:
        return None
    out = as_float_array(quality, "quality", finite=True)
    if out.shape != (n,):
        raise ShapeError(f"quality must be ({n},), one number per item, got {out.shape}")
    return out


def failed(reason: Reason, n: int, freedom: int, num_iterations: int = 0) -> Found:
    """The result if nothing was found."""
    return Found(
        reason,
        np.full(MODEL_SIZE, np.nan),
        np.full(n, np.inf),
        np.zeros(n, bool),
        num_iterations,
        np.inf,
        np.nan,
        np.full((freedom, freedom), np.inf),
    )


def run_loop(
    problem: Any, order: np.ndarray, n: int, scale_px: float, config: RansacConfig, quality: np.ndarray | None
) -> Found:
    """Robustly fit a problem whose column k is the caller's item order[k].

    Args:
        problem: an instance of a problem class.
        order: (m,), the caller's index of each item in the problem.
        n: number of the caller's items.
        scale_px: the unit of the problem's residuals in the caller's unit.
        config: threshold in the caller's unit.
        quality: (n,) for PROSAC, or None.
    """
    m = len(order)
    if m < problem.sample_size():
        return failed(Reason.TOO_FEW, n, int(problem.degrees_of_freedom()))
    ranking = None if quality is None else np.argsort(-quality[order], kind="stable")
    needed = config.needed_inliers(int(problem.sample_size()), int(problem.residual_size()))
    raw, residuals = np.zeros(MODEL_SIZE), np.full(m, np.inf)
    information = np.zeros((MOST_FREEDOM, MOST_FREEDOM))
    score, iterations = loop.ransac(
        problem,
        float((config.max_error_px / scale_px) ** 2),
        config.confidence,
        config.min_iterations,
        config.max_iterations,
        min(1.0, max(config.min_inlier_ratio, needed / m)),
        np.uint64(config.seed % 2**64),
        ranking,
        raw,
        residuals,
        information,
    )
    out = np.full(n, np.inf)
    out[order] = np.sqrt(residuals) * scale_px
    answer = LoopAnswer(float(score), int(iterations), raw, out, information)
    return found_by_loop(problem, answer, scale_px, config)


class LoopAnswer(NamedTuple):
    """Output of the loop; in the problem's coordinates, except for the residuals."""

    score: float
    num_iterations: int
    raw: np.ndarray
    """(MODEL_SIZE,), in kernel layout."""
    residuals: np.ndarray
    """(n,), in the caller's order and unit."""
    information: np.ndarray
    """J^T J of the inliers."""


def found_by_loop(problem: Any, answer: LoopAnswer, scale_px: float, config: RansacConfig) -> Found:
    """Inliers, noise and covariance from the output of the loop.

    Args:
        problem: an instance of the class that was fitted; its items are not used.
        answer: output of the loop.
        scale_px: the unit of the problem's residuals in the caller's unit.
        config: threshold in the caller's unit, and inliers needed.
    """
    score, num_iterations, raw, residuals, information = answer
    freedom = int(problem.degrees_of_freedom())
    if not np.isfinite(score):
        return failed(Reason.NO_MODEL, len(residuals), freedom, num_iterations)
    inlier_mask = residuals < config.max_error_px
    noise = untruncated_noise(
        residuals[inlier_mask], config.max_error_px, int(problem.residual_size()), freedom
    )
    covariance, determined = invert_information(
        information[:freedom, :freedom], noise / scale_px, of_order_one=problem.has_unit_steps
    )
    if int(inlier_mask.sum()) < config.needed_inliers(
        int(problem.sample_size()), int(problem.residual_size())
    ):
        reason = Reason.TOO_FEW if inlier_mask.all() else Reason.TOO_FEW_INLIERS
    else:
        reason = Reason.OK if determined else Reason.DEGENERATE
    score_px = score * scale_px**2
    return Found(reason, raw, residuals, inlier_mask, num_iterations, score_px, noise, covariance)


def untruncated_noise(residuals: np.ndarray, threshold: float, size: int, freedom: int) -> float:
    """Standard deviation of a coordinate, from residuals of dimension `size` below a threshold.

    The mean of r^2 below k sigma is size sigma^2 P(size / 2 + 1, k^2 / 2) / P(size / 2, k^2 / 2) with the regularized
    incomplete gamma function P.
    """
    unknowns = size * len(residuals) - freedom
    if unknowns <= 0:
        return float("nan")
    mean_square = float((residuals**2).sum()) / unknowns
    sigma = np.sqrt(mean_square)
    for _ in range(20):
        half = 0.5 * (threshold / max(sigma, 1e-9 * threshold)) ** 2
        if half > 50.0:
            break
        kept = gammainc(0.5 * size + 1.0, half) / gammainc(0.5 * size, half)
        # Noise as wide as the threshold is indistinguishable from no model at all: limit it to the threshold.
        sigma = min(np.sqrt(mean_square / max(kept, 1e-3)), threshold)
    return float(sigma)


def invert_information(
    information: np.ndarray, sigma: float, *, of_order_one: bool = False
) -> tuple[np.ndarray, bool]:
    """(sigma^2 (J^T J)^-1, whether it exists); infinite if not."""
    diagonal = np.einsum("ii->i", information)
    nothing = np.full(information.shape, np.inf)
    least = SINGULAR * diagonal.max() if of_order_one else 0.0
    if not (np.isfinite(information).all() and (diagonal > least).all()):
        return nothing, False
    root = np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(information / np.outer(root, root))
    if values[0] < SINGULAR:
        return nothing, False
    return sigma**2 * ((vectors / values) @ vectors.T) / np.outer(root, root), True
