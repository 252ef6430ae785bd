"""Test whether GPS positions belong to the images: a robust fit, compared with fits of shuffled positions.

Some similarity always fits part of any set of positions. GPS is trusted if the model fits much better than the spread
of the positions and, with enough of them, much better than the same positions shuffled among the images (a permutation
test: Fisher, The Design of Experiments, 1935). Two kinds of fit are tried, each against its own shuffles:

- in 3D, without an assumption about the up direction: three images determine a similarity;
- horizontally, for each possible up direction: two images determine scale, heading and translation. This needs no
  altitudes, which GPS measures worst.

Both minimize the median distance over samples (Rousseeuw, Least Median of Squares, JASA 1984), which tolerates many
wrong positions; the 3D fit is then refined by concentration steps (Rousseeuw and Van Driessen, FAST-LTS, 2006).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float64

from epipole.geometry import Rotation3

MAX_POSITIONS = 60
"""Positions that are used, at most; more are thinned evenly, as they do not change the result."""
MAX_SAMPLES = 100
"""Pairs or triples of images that are sampled, at most."""
NUM_SHUFFLES = 199
NUM_CONCENTRATIONS = 3
MIN_TO_SHUFFLE = 7
"""Fewer images have too few permutations for the test."""
MIN_DEVIATIONS = 4.0
"""Standard deviations by which the logarithm of a convincing fit lies below the mean of the shuffled fits."""
MAX_RESIDUAL_TO_SPREAD = 0.5
MAX_RESIDUAL_TO_SPREAD_OF_FEW = 0.3
"""Limit without shuffles; one or two in a hundred sets of random positions fit as well."""


@dataclass(frozen=True, slots=True)
class GpsEvidence:
    """How well GPS positions fit a model."""

    num_positions: int
    residual_m: float
    """More than half of the images are within this distance of their GPS position, after the best fit."""
    spread_m: float
    """Median horizontal distance of the GPS positions from their median."""
    deviations: float
    """Distance of the fit below shuffled fits, in standard deviations of their logarithm; NaN for few positions."""

    @property
    def is_convincing(self) -> bool:
        """Whether the positions belong to the images."""
        if self.num_positions < MIN_TO_SHUFFLE:
            return self.residual_m <= MAX_RESIDUAL_TO_SPREAD_OF_FEW * self.spread_m
        return self.residual_m <= MAX_RESIDUAL_TO_SPREAD * self.spread_m and self.deviations >= MIN_DEVIATIONS

    def in_words(self) -> str:
        """Explanation of why the GPS positions are not used."""
        words = (
            f"after the best fit about half of the {self.num_positions} images are {meters_in_words(self.residual_m)} or more "
            f"from their GPS positions, which spread over {meters_in_words(self.spread_m)}"
        )
        if self.deviations < MIN_DEVIATIONS:
            words += "; positions shuffled among the images fit about as well"
        return words


def meters_in_words(length_m: float) -> str:
    """Length with two digits if below ten meters."""
    return f"{length_m:.0f} m" if length_m >= 10.0 else f"{length_m:.2g} m"


def gps_evidence(
    centers: Float64[np.ndarray, "n 3"],
    positions_enu: Float64[np.ndarray, "n 3"],
    up_directions: Sequence[Float64[np.ndarray, 3]],
    seed: int = 0,
) -> GpsEvidence:
    """Compare GPS positions with camera centers; rows without a center or a horizontal position are ignored.

    Args:
        centers: camera centers in the model's coordinates, of any scale and orientation.
        positions_enu: meters east, north and up; up is NaN without a recorded altitude.
        up_directions: possible up directions in the model's coordinates, as unit vectors, most likely first.
        seed: random seed.
    """
    usable = np.flatnonzero(np.isfinite(centers).all(axis=1) & np.isfinite(positions_enu[:, :2]).all(axis=1))
    num_positions = len(usable)
    if num_positions < 3:
        return GpsEvidence(num_positions, float("inf"), 0.0, float("nan"))
    if num_positions > MAX_POSITIONS:
        usable = usable[np.linspace(0, num_positions - 1, MAX_POSITIONS).astype(int)]
    source, target = centers[usable], positions_enu[usable]
    offsets = target[:, :2] - np.median(target[:, :2], axis=0)
    spread_m = float(np.median(np.hypot(*offsets.T)))
    can_shuffle = num_positions >= MIN_TO_SHUFFLE
    num_shuffles = NUM_SHUFFLES if can_shuffle else 0
    orders = _orders(len(usable), num_shuffles, seed)
    # Each further direction is another try for chance, so few positions are compared for the most likely one only.
    directions = up_directions if can_shuffle else up_directions[:1]
    fits = [_horizontal_fits(source, target[:, :2], up, orders, seed) for up in directions]
    has_altitude = np.isfinite(target[:, 2])
    if has_altitude.sum() >= max(MIN_TO_SHUFFLE, len(usable) / 2):
        orders = _orders(int(has_altitude.sum()), num_shuffles, seed)
        fits.append(_spatial_fits(source[has_altitude], target[has_altitude], orders, seed))
    found = [GpsEvidence(num_positions, float(f[0]), spread_m, _deviations(f)) for f in fits]
    return min(found, key=lambda e: (not e.is_convincing, e.residual_m))


def _orders(count: int, num_shuffles: int, seed: int) -> np.ndarray:
    """(1 + shuffles, count): the identity, then random permutations."""
    random = np.random.default_rng(seed)
    return np.stack([np.arange(count), *(random.permutation(count) for _ in range(num_shuffles))])


def _deviations(fits: np.ndarray) -> float:
    """Deviation of the first fit from the others, in standard deviations of their logarithms."""
    if len(fits) < 2:
        return float("nan")
    if not np.isfinite(fits).all():
        return 0.0  # a model without extent does not fit
    logs = np.log(np.maximum(fits, 1e-12 * max(float(fits.max()), 1e-300)))
    return float((logs[1:].mean() - logs[0]) / max(float(logs[1:].std()), 1e-9))


def _middle(count: int) -> int:
    """Index of the residual to minimize; with four images, at least two besides a sample must agree."""
    return min((count + 4) // 2, count) - 1


def _samples(count: int, size: int, seed: int) -> np.ndarray:
    """(k, size) all subsets if there are few, else random ones."""
    random = np.random.default_rng(seed)
    if count <= 12:
        every = np.array(list(combinations(range(count), size)))
        return (
            every
            if len(every) <= MAX_SAMPLES
            else every[random.choice(len(every), MAX_SAMPLES, replace=False)]
        )
    return np.argsort(random.random((MAX_SAMPLES, count)), axis=1)[:, :size]


def _horizontal_fits(
    source: np.ndarray, target: np.ndarray, up: np.ndarray, orders: np.ndarray, seed: int
) -> np.ndarray:
    """Least median distance of each permutation, over 2D similarities through two images (as complex numbers)."""
    level = source @ Rotation3.from_two_vectors(up, np.array([0.0, 0.0, 1.0])).matrix.T
    a, b = level[:, :2] @ (1, 1j), (target @ (1, 1j))[orders]
    reach, middle = np.abs(a - a.mean()).max(), _middle(len(a))
    best = np.full(len(orders), np.inf)
    for i, j in _samples(len(a), 2, seed):
        step = a[j] - a[i]
        if abs(step) <= 1e-9 * reach:
            continue
        factor = (b[:, j] - b[:, i]) / step
        residuals = np.abs(b - b[:, [i]] - factor[:, None] * (a - a[i]))
        best = np.minimum(best, np.partition(residuals, middle, axis=1)[:, middle])
    return best


def _spatial_fits(source: np.ndarray, target: np.ndarray, orders: np.ndarray, seed: int) -> np.ndarray:
    """Least median distance of each permutation, over similarities through three images, refined on the nearer half."""
    middle, samples = _middle(len(source)), _samples(len(source), 3, seed)
    targets = target[orders]
    best, kept = np.full(len(orders), np.inf), np.zeros((len(orders), middle + 1), np.int64)
    rows = np.arange(len(orders))[:, None]
    for sample in samples:
        chosen = np.broadcast_to(sample, (len(orders), 3))
        best, kept = _better(source, targets, chosen, rows, middle, best, kept)
    for _ in range(NUM_CONCENTRATIONS):
        best, kept = _better(source, targets, kept, rows, middle, best, kept)
    return best


def _better(
    source: np.ndarray,
    targets: np.ndarray,
    chosen: np.ndarray,
    rows: np.ndarray,
    middle: int,
    best: np.ndarray,
    kept: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Least median distance and nearer half of each permutation, after a fit to its chosen images."""
    residuals = _residuals(source, targets, chosen, rows)
    nearest = np.argpartition(residuals, middle, axis=1)[:, : middle + 1]
    fits = np.take_along_axis(residuals, nearest, axis=1).max(axis=1)
    is_better = fits < best
    return np.where(is_better, fits, best), np.where(is_better[:, None], nearest, kept)


def _residuals(source: np.ndarray, targets: np.ndarray, chosen: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(orders, n) distances after the batched least-squares similarity of the chosen rows (Umeyama, PAMI 1991)."""
    a, b = source[chosen], targets[rows, chosen]
    mean_a, mean_b = a.mean(axis=1, keepdims=True), b.mean(axis=1, keepdims=True)
    centered = a - mean_a
    u, singular, vt = np.linalg.svd(np.swapaxes(b - mean_b, 1, 2) @ centered)
    sign = np.ones_like(singular)
    sign[:, 2] = np.sign(np.linalg.det(u @ vt))
    power = np.maximum((centered**2).sum(axis=(1, 2)), 1e-300)
    scale = ((singular * sign).sum(axis=1) / power)[:, None, None]
    moved = scale * ((source - mean_a) @ np.swapaxes((u * sign[:, None, :]) @ vt, 1, 2)) + mean_b
    return np.linalg.norm(moved - targets, axis=2)
