"""Robust losses rho(s) of the squared residual s, with rho(s) ~ s for small s."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, checked
from epipole.errors import ConfigError


class Loss(IntEnum):
    """The losses of bundle adjustment."""

    TRIVIAL = 0
    """Plain least squares."""
    HUBER = 1
    SOFT_L1 = 2
    CAUCHY = 3
    TRUNCATED = 4
    TUKEY = 5


@checked
def evaluate_loss(loss: Loss, squared: Any, scale: float) -> Float64[np.ndarray, "*batch"]:
    """rho(s) for residuals of squared size s; the loss flattens beyond `scale` (Triggs et al. 2000, section 3).

    Raises:
        ConfigError: scale is not positive and finite.
    """
    if not 0 < scale < np.inf:
        raise ConfigError(f"scale must be positive and finite, got {scale}")
    s, c = as_float_array(squared, "squared"), scale * scale
    if loss is Loss.HUBER:
        return np.where(s <= c, s, 2.0 * np.sqrt(np.maximum(s, c) * c) - c)
    if loss is Loss.SOFT_L1:
        return 2.0 * c * (np.sqrt(1.0 + s / c) - 1.0)
    if loss is Loss.CAUCHY:
        return c * np.log1p(s / c)
    if loss is Loss.TUKEY:
        return c / 3.0 * (1.0 - np.maximum(1.0 - s / c, 0.0) ** 3)
    return np.minimum(s, c) if loss is Loss.TRUNCATED else s
