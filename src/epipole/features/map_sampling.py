"""Interpolation of the maps that networks compute, as in torch.nn.functional.grid_sample."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32

_CUBIC = -0.75
"""Coefficient of the bicubic kernel, torch's."""
Weights = Callable[[np.ndarray], list[tuple[int, np.ndarray]]]
"""From a position's fraction (n,): offset of each element that contributes, and its weights (n,)."""


def linear_weights(fraction: Float32[np.ndarray, " n"]) -> list[tuple[int, np.ndarray]]:
    """Weights of linear interpolation."""
    return [(0, 1 - fraction), (1, fraction)]


def cubic_weights(fraction: Float32[np.ndarray, " n"]) -> list[tuple[int, np.ndarray]]:
    """Weights of cubic convolution (Keys, 1981)."""

    def near(d: np.ndarray) -> np.ndarray:
        return ((_CUBIC + 2) * d - (_CUBIC + 3)) * d * d + 1

    def far(d: np.ndarray) -> np.ndarray:
        return ((_CUBIC * d - 5 * _CUBIC) * d + 8 * _CUBIC) * d - 4 * _CUBIC

    return [(-1, far(1 + fraction)), (0, near(fraction)), (1, near(1 - fraction)), (2, far(2 - fraction))]


def sample_map(
    values: Float32[np.ndarray, "c h w"], positions: Float32[np.ndarray, "n 2"], weights: Weights
) -> Float32[np.ndarray, "n c"]:
    """Interpolate a map at positions (x, y) in elements, (0, 0) being the center of the first; zero outside the map."""
    _, rows, columns = values.shape
    by_element = np.ascontiguousarray(values.transpose(1, 2, 0))
    first = np.floor(positions)
    fraction = positions - first
    x0, y0 = first.astype(np.int64).T
    out = np.zeros((len(positions), len(values)), np.float32)
    for dy, weight_y in weights(fraction[:, 1]):
        for dx, weight_x in weights(fraction[:, 0]):
            x, y = x0 + dx, y0 + dy
            is_inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
            weight = np.where(is_inside, weight_x * weight_y, np.float32(0))
            out += weight[:, None] * by_element[np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)]
    return out
