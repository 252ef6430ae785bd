"""Gaussians packed into bytes for a page: 32 each, and 12 more for view-dependent color."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from epipole.scene.gaussian_cloud import DC, GaussianCloud

ROW = np.dtype(
    [
        ("mean", "<f4", 3),
        ("color", "<u4"),
        ("quat_wxyz", "<i2", 4),
        ("log_scale", "<u2", 3),
        ("opacity", "<u2"),
    ]
)
"""Color is the view-independent part: red, green and blue with 10 bits each, red in the lowest bits."""
DEGREE_KEPT = 1
"""Degree of the harmonics that are kept: the coefficients for -y, z and -x are three more words, packed like the
color."""
MOST_LOG_SCALE = 40.0
COLORS, HARMONICS = (-1.0, 2.0), (-2.0, 2.0)
"""Values outside these ranges, which are very rare, are clipped."""

Range = tuple[float, float]
"""The value represented by 0, and the span up to the largest integer."""


@dataclass(frozen=True, slots=True, eq=False)
class PackedGaussians:
    """The packed data that the page's script unpacks."""

    rows: bytes
    """Array of `ROW`."""
    harmonics: bytes | None
    """Three 32-bit words each; None if colors do not depend on direction."""
    scale_range: Range
    color_range: Range
    harmonic_range: Range


def most_visible(cloud: GaussianCloud, most: int) -> Int64[np.ndarray, " m"]:
    """Rows, in order, of the at most `most` Gaussians with the largest opacity times area of the largest face."""
    if len(cloud) <= most:
        return np.arange(len(cloud))
    return np.sort(np.argpartition(-log_visibility(cloud), most)[:most])


def log_visibility(cloud: GaussianCloud) -> Float64[np.ndarray, " n"]:
    """The logarithm of opacity times the area of the largest face."""
    lengths = np.sort(np.clip(cloud.log_scales.astype(np.float64), -MOST_LOG_SCALE, MOST_LOG_SCALE), axis=1)
    # The logarithm of the opacity, from its logit.
    return lengths[:, 1] + lengths[:, 2] - np.logaddexp(0.0, -cloud.opacity_logits.astype(np.float64))


def packed(cloud: GaussianCloud) -> PackedGaussians:
    """Pack Gaussians: positions unchanged, everything else quantized within its range."""
    rows = np.empty(len(cloud), ROW)
    quats = cloud.quats_wxyz.astype(np.float64)
    quats /= np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    colors = 0.5 + DC * cloud.sh[:, 0].astype(np.float64)
    log_scales = np.clip(cloud.log_scales.astype(np.float64), -MOST_LOG_SCALE, MOST_LOG_SCALE)
    scale_range, color_range = _range_of(log_scales), _range_of(np.clip(colors, *COLORS))
    rows["mean"] = cloud.means_in_world
    rows["color"] = _words(colors, color_range)
    rows["quat_wxyz"] = np.rint(32767.0 * quats)
    rows["log_scale"] = _steps(log_scales, scale_range, 65535)
    logits = np.clip(cloud.opacity_logits.astype(np.float64), -50.0, 50.0)
    rows["opacity"] = np.rint(65535.0 / (1.0 + np.exp(-logits)))
    if cloud.sh_degree < DEGREE_KEPT:
        return PackedGaussians(rows.tobytes(), None, scale_range, color_range, (0.0, 0.0))
    first = np.clip(cloud.sh[:, 1:4].astype(np.float64), *HARMONICS)
    harmonic_range = _range_of(first)
    words = np.stack([_words(first[:, k], harmonic_range) for k in range(3)], axis=1)
    return PackedGaussians(
        rows.tobytes(), words.astype("<u4").tobytes(), scale_range, color_range, harmonic_range
    )


def _range_of(values: np.ndarray) -> Range:
    low, high = float(values.min()), float(values.max())
    return low, high - low


def _steps(values: np.ndarray, within: Range, most: int) -> np.ndarray:
    low, span = within
    return np.clip(np.rint((values - low) * (most / max(span, 1e-30))), 0, most)


def _words(triples: np.ndarray, within: Range) -> np.ndarray:
    steps = _steps(triples, within, 1023).astype(np.uint32)
    return steps[:, 0] | steps[:, 1] << 10 | steps[:, 2] << 20
