"""Scalar values as colors."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from epipole._checks import checked


@checked
def color_range(values: Float[np.ndarray, "*shape"]) -> tuple[float, float]:
    """Values of the first and the last color: 1st and 99th percentile of the finite values; 0, 1 if there are none."""
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (1, 99))
    return float(low), float(high)


@checked
def color_map(
    values: Float[np.ndarray, "*shape"], limits: tuple[float, float] | None = None
) -> UInt8[np.ndarray, "*shape 3"]:
    """Turbo colors (RGB) from blue to red over `limits`, by default `color_range`; black for non-finite values."""
    known = np.isfinite(values)
    low, high = color_range(values) if limits is None else limits
    scaled = np.where(known, (values - low) / max(high - low, 1e-12), 0.0)
    steps = (255 * np.clip(scaled, 0, 1)).astype(np.uint8)
    bgr = (
        cv2.applyColorMap(steps.reshape(-1, 1), cv2.COLORMAP_TURBO)
        if steps.size
        else np.zeros((0, 3), np.uint8)
    )
    rgb = bgr.reshape(*steps.shape, 3)[..., ::-1].copy()
    rgb[~known] = 0
    return np.asarray(rgb, np.uint8)
