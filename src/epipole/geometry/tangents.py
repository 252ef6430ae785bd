"""Inverse Jacobians of the exponential map, for SE(2), SE(3) and Sim(3)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.geometry.rotation3 import skew

_BERNOULLI = (1.0, 0.5, 1.0 / 12.0, 0.0, -1.0 / 720.0, 0.0, 1.0 / 30240.0, 0.0, -1.0 / 1209600.0)
"""Coefficients of the series of the inverse right Jacobian in ad(r): they decay faster than powers of a fifth."""
_NEGLIGIBLE = 1e-10


@checked
def inverse_right_jacobian(xi: Float64[np.ndarray, "n d"]) -> Float64[np.ndarray, "n d d"]:
    """D log(exp(xi) exp(delta)) / d delta as a series in ad(xi), to the eighth power: error 1e-9 below one radian.

    Args:
        xi: tangents (translation, rotation[, log scale]) of 3, 6 or 7 numbers (Barfoot 2017, section 7.1.5).
    """
    d = xi.shape[1]
    ad = np.zeros((len(xi), d, d))
    if d == 3:
        ad[:, 0, 1], ad[:, 1, 0] = -xi[:, 2], xi[:, 2]
        ad[:, 0, 2], ad[:, 1, 2] = xi[:, 1], -xi[:, 0]
        return _series(ad)
    ad[:, :3, :3] = ad[:, 3:6, 3:6] = skew(xi[:, 3:6])
    ad[:, :3, 3:6] = skew(xi[:, :3])
    if d == 7:
        ad[:, :3, :3] += xi[:, 6, None, None] * np.eye(3)
        ad[:, :3, 6] = -xi[:, :3]
    return _series(ad)


@checked
def inverse_left_jacobian(xi: Float64[np.ndarray, "n d"]) -> Float64[np.ndarray, "n d d"]:
    """D log(exp(delta) exp(xi)) / d delta, like `inverse_right_jacobian`."""
    return inverse_right_jacobian(-xi)


def _series(ad: np.ndarray) -> np.ndarray:
    size = float(np.abs(ad).sum(axis=2).max(initial=0.0))
    out, power, reach = np.zeros_like(ad), np.broadcast_to(np.eye(ad.shape[-1]), ad.shape), 1.0
    for order, coefficient in enumerate(_BERNOULLI):
        if order > 1 and reach < _NEGLIGIBLE:  # all later terms are smaller
            break
        if coefficient:
            out = out + coefficient * power
        power, reach = power @ ad, reach * size / 5.0
    return out
