"""Whether GPS places belong to the pictures that carry them: what a fit explains, against what chance explains.

A similarity from the model to the fixes has four horizontal unknowns and finds some fit to any fixes at all. The
places are believed where they lie much nearer to the cameras than to their own middle and, with enough of them for
chance to be measured, where the same fixes shuffled among the pictures hardly ever fit as well (a permutation test:
Fisher, The Design of Experiments, 1935). The fit is the similarity of least median distance over pairs of pictures
(Rousseeuw, Least Median of Squares, JASA 1984), so that many of the fixes may be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float64

MAX_FIXES, MAX_PAIRS, NUM_SHUFFLES = 60, 100, 199
LEAST_TO_SHUFFLE = 7
"""Fewer have too few orders for chance to be measured."""
MAX_CHANCE = 0.01
MAX_SHARE, MAX_SHARE_OF_FEW = 0.5, 0.3
"""Largest residual as a share of the spread; one or two in a hundred sets of random fixes stay below."""


@dataclass(frozen=True, slots=True)
class GpsEvidence:
    """How well fixes fit a model."""

    num_fixes: int
    residual_m: float
    """More than half of the pictures lie within this distance of their fixes, after the best fit."""
    spread_m: float
    """Median distance of the fixes from their own middle."""
    chance: float
    """Share of the trials in which shuffled fixes fit as well; NaN for few fixes."""

    @property
    def is_convincing(self) -> bool:
        """The fixes are where the pictures were taken."""
        if self.num_fixes < LEAST_TO_SHUFFLE:
            return self.residual_m <= MAX_SHARE_OF_FEW * self.spread_m
        return self.residual_m <= MAX_SHARE * self.spread_m and self.chance <= MAX_CHANCE

    def in_words(self) -> str:
        """What was found, for a reader who is told that the fixes are not believed."""
        words = (
            f"after the best fit about half of the {self.num_fixes} pictures lie {_metres(self.residual_m)} or more "
            f"from their GPS places, which lie {_metres(self.spread_m)} around their own middle"
        )
        if self.chance > MAX_CHANCE:
            words += (
                f"; shuffled among the pictures they fit as well in {100 * self.chance:.0f} % of the trials"
            )
        return words


def _metres(length_m: float) -> str:
    """To two digits, for lengths below ten metres too."""
    return f"{length_m:.0f} m" if length_m >= 10.0 else f"{length_m:.2g} m"


def gps_evidence(
    centers: Float64[np.ndarray, "n 3"], positions_enu: Float64[np.ndarray, "n 3"], seed: int = 0
) -> GpsEvidence:
    """Compare fixes with the camera centres of an upright model, in the horizontal plane; rows with NaN do not count.

    Args:
        centers: of the cameras, z up.
        positions_enu: fixes in local metres.
        seed: of the shuffling.
    """
    usable = np.flatnonzero(np.isfinite(centers).all(axis=1) & np.isfinite(positions_enu[:, :2]).all(axis=1))
    num_fixes = len(usable)
    if num_fixes > MAX_FIXES:
        usable = usable[np.linspace(0, num_fixes - 1, MAX_FIXES).astype(int)]
    source, target = centers[usable, :2] @ (1, 1j), positions_enu[usable, :2] @ (1, 1j)
    if len(usable) < 3:
        return GpsEvidence(num_fixes, float("inf"), 0.0, float("nan"))
    random = np.random.default_rng(seed)
    pairs = np.array(list(combinations(range(len(usable)), 2)))
    if len(pairs) > MAX_PAIRS:
        pairs = pairs[random.choice(len(pairs), MAX_PAIRS, replace=False)]
    middle = np.median(target.real) + 1j * np.median(target.imag)
    spread_m = float(np.median(np.abs(target - middle)))
    shuffles = NUM_SHUFFLES if num_fixes >= LEAST_TO_SHUFFLE else 0
    targets = np.stack([target, *(random.permutation(target) for _ in range(shuffles))])
    fits = _least_median(source, targets, pairs)
    chance = float((fits <= fits[0]).mean()) if shuffles else float("nan")
    return GpsEvidence(num_fixes, float(fits[0]), spread_m, chance)


def _least_median(source: np.ndarray, targets: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """For each row of targets the least, over similarities through a pair, of the middle residual; complex numbers.

    Two residuals of n are zero; the middle one is the number n / 2 + 2, so that two others at least agree, of four.
    """
    middle = min((len(source) + 4) // 2, len(source)) - 1
    apart = source[pairs[:, 1]] - source[pairs[:, 0]]
    reach = np.abs(source - source.mean()).max()
    best = np.full(len(targets), np.inf)
    for (i, j), step in zip(pairs, apart):
        if abs(step) <= 1e-9 * reach:
            continue
        factor = (targets[:, j] - targets[:, i]) / step
        residuals = np.abs(targets - targets[:, [i]] - factor[:, None] * (source - source[i]))
        best = np.minimum(best, np.partition(residuals, middle, axis=1)[:, middle])
    return best
