"""The scale of a model from measured positions, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import Declared, checked
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Similarity3, align_points

LEAST_POSITIONS = 5
LEAST_SPREAD = 5.0
"""Minimum spread of the positions, in standard deviations of one of them."""
OUTLIER, ROUNDS = 3.0, 10


@dataclass(frozen=True, slots=True, eq=False)
class ScaleFit(Declared):
    """A similarity from the model to the world, with the uncertainty of its scale."""

    world_from_model: Similarity3
    sigma: float
    """Standard deviation of the scale."""
    kept_mask: Bool[np.ndarray, " n"]
    """Positions that agree."""
    residual_m: float
    """RMS distance of the positions that agree."""

    def __repr__(self) -> str:
        scale = float(self.world_from_model.scale)
        return f"ScaleFit(scale {scale:.6g} +- {self.sigma:.2g}, {int(self.kept_mask.sum())} of {len(self.kept_mask)})"


@checked
def fit_scale_to_positions(
    positions_in_model: Float64[np.ndarray, "n 3"],
    positions_in_world: Float64[np.ndarray, "n 3"],
    sigma: float,
) -> ScaleFit:
    """Least-squares similarity (Umeyama, PAMI 1991) over positions that agree, with its scale's standard deviation.

    With centered model positions a, var(s) = sigma^2 / sum |a|^2, as the residuals' derivative by the scale is R a. Sigma
    is the stated one, or that of the residuals if larger.

    Args:
        positions_in_model: camera positions, in the model's unit.
        positions_in_world: the same positions as measured, in meters.
        sigma: standard deviation of a measured coordinate, in meters.

    Raises:
        DegenerateGeometryError: too few positions, collinear, or too close together for their uncertainty.
        ConfigError: sigma is not positive.
        ShapeError: a coordinate is not finite.
    """
    if not 0 < sigma < np.inf:
        raise ConfigError(f"sigma must be positive and finite, got {sigma}")
    if not (np.isfinite(positions_in_model).all() and np.isfinite(positions_in_world).all()):
        raise ShapeError("positions must be finite")
    kept = np.ones(len(positions_in_model), bool)
    for _ in range(ROUNDS):
        if kept.sum() < LEAST_POSITIONS:
            raise DegenerateGeometryError(
                f"{int(kept.sum())} positions agree, {LEAST_POSITIONS} are needed to determine the scale"
            )
        found = align_points(positions_in_model[kept], positions_in_world[kept])
        off = np.linalg.norm(found.apply(positions_in_model) - positions_in_world, axis=1)
        limit = OUTLIER * max(np.sqrt(3.0) * sigma, 1.4826 * float(np.median(off)))
        if np.array_equal(off <= limit, kept):
            break
        kept = off <= limit
    return _judged(found, positions_in_model, positions_in_world, off, kept, sigma)


def _judged(
    found: Similarity3, model: np.ndarray, world: np.ndarray, off: np.ndarray, kept: np.ndarray, sigma: float
) -> ScaleFit:
    a, b = model[kept] - model[kept].mean(axis=0), world[kept] - world[kept].mean(axis=0)
    residual = float(np.sqrt((off[kept] ** 2).mean()))
    each = max(sigma, residual / np.sqrt(3.0))
    spread = float(np.sqrt((b**2).sum(axis=1).mean()))
    if spread < LEAST_SPREAD * each:
        raise DegenerateGeometryError(
            f"the positions spread over {spread:.3g} m with errors of {each:.3g} m: too little to determine the scale"
        )
    return ScaleFit(found, each / float(np.sqrt((a**2).sum())), kept, residual)
