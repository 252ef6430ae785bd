"""Scale-invariant features (Lowe, IJCV 2004): extrema of a scale space, their orientations and descriptors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from epipole._checks import checked
from epipole.config import FeatureConfig
from epipole.errors import ConfigError, ShapeError
from epipole.features import _scale_space_kernels as space
from epipole.features import _sift_kernels as kernels
from epipole.features.features import Features, in_order

_SIGMA = 1.6
"""Blur of the first level of every octave, in pixels of the octave."""
_CAMERA_SIGMA = 0.5
"""Assumed blur of the input image."""
PIXELS_PER_FEATURE = 200
"""Pixels of an image per wanted feature above which the doubled octave is computed only if it is needed."""
_POOLED_OCTAVES = 1.0
"""Windows that are averaged are smaller and larger than the feature's by up to this many octaves."""
_LEAST_SIDE = 2 * space.BORDER + 2
_MOST_EDGE = 10.0
"""Largest ratio of principal curvatures: along edges the position is undetermined."""


def detect_sift(gray: UInt8[np.ndarray, "h w"], config: FeatureConfig) -> Features:
    """The largest-scale SIFT features of a gray image, as root-SIFT.

    The first octave has twice the image's size. Pixel (x, y) of the image is pixel (2 x, 2 y) there, so keypoints are
    not shifted. It has most of the work and the smallest features: with more than `PIXELS_PER_FEATURE` pixels per wanted feature, the
    larger octaves, here computed from the image itself, usually have enough features. Work per pixel of an octave: five blurs of 11 to
    27 taps along rows and columns, then 27 comparisons for each of three levels.

    Args:
        gray: at least 16 pixels per side.
        config: `max_features`, `contrast_threshold` and `domain_sizes`.
    """
    limit, threshold = config.max_features, config.contrast_threshold
    if gray.size > PIXELS_PER_FEATURE * limit:
        octaves = [_Octave.of(levels, 2.0**n, threshold) for n, levels in enumerate(_octaves(_base(gray)))]
        if sum(len(o.extrema) for o in octaves) < limit:
            octaves.insert(0, _Octave.of(next(_octaves(_doubled_base(gray))), 0.5, threshold))
    else:
        levels_of = enumerate(_octaves(_doubled_base(gray)))
        octaves = [_Octave.of(levels, 0.5 * 2.0**n, threshold) for n, levels in levels_of]
    pixel = np.concatenate([np.full(len(o.extrema), o.pixel) for o in octaves])
    sigma = np.concatenate([o.sigma() for o in octaves])
    largest = np.argsort(-sigma * pixel, kind="stable")[:limit]
    wanted = np.zeros(len(pixel), bool)
    wanted[largest] = True
    ends = np.cumsum([0, *(len(o.extrema) for o in octaves)])
    sizes = _domain_sizes(config.domain_sizes)
    parts = [_describe(o, wanted[a:b], sizes) for o, a, b in zip(octaves, ends, ends[1:])]
    columns, descriptors = (np.concatenate(c) for c in zip(*parts))
    return in_order(columns, descriptors, limit)


@dataclass(frozen=True, slots=True, eq=False)
class _Octave:
    """The inner levels of an octave, and their extrema."""

    levels: tuple[Float32[np.ndarray, "h w"], ...]
    extrema: Float32[np.ndarray, "n 4"]
    """x, y and scale in the octave's units, and level."""
    pixel: float
    """Side of a pixel of the octave, in pixels of the image."""

    @staticmethod
    def of(levels: tuple[np.ndarray, ...], pixel: float, contrast_threshold: float) -> _Octave:
        """The extrema of these levels."""
        return _Octave(levels[1 : 1 + space.SCALES], _find_extrema(levels, contrast_threshold), pixel)

    def sigma(self) -> np.ndarray:
        """Scale of each extremum, in pixels of the octave."""
        return _SIGMA * 2.0 ** (self.extrema[:, 2].astype(np.float64) / space.SCALES)


def _base(gray: np.ndarray) -> np.ndarray:
    """First level of the octave with the image's size; white is 1."""
    scaled = gray.astype(np.float32) / np.float32(255.0)
    return _blurred(scaled, np.sqrt(_SIGMA**2 - _CAMERA_SIGMA**2))


def _doubled_base(gray: np.ndarray) -> np.ndarray:
    """First level of the octave with twice the image's size; white is 1."""
    height, width = gray.shape
    doubled = np.empty((2 * height, 2 * width), np.float32)
    space.upsample(gray, doubled)
    return _blurred(doubled, np.sqrt(_SIGMA**2 - (2.0 * _CAMERA_SIGMA) ** 2))


def _octaves(base: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """Levels of each octave from the first level of the first; every octave is half the size of the previous one."""
    steps = [_SIGMA * 2.0 ** (s / space.SCALES) for s in range(space.SCALES + 3)]
    while min(base.shape) >= _LEAST_SIDE:
        levels = [base]
        for before, after in pairwise(steps):
            levels.append(_blurred(levels[-1], np.sqrt(after**2 - before**2)))
        yield tuple(levels)
        base = np.empty((base.shape[0] // 2, base.shape[1] // 2), np.float32)
        space.halve(levels[space.SCALES], base)


def _blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    out = np.empty_like(image)
    space.blur(image, _gaussian(sigma), out)
    return out


def _gaussian(sigma: float) -> Float32[np.ndarray, " r"]:
    """Weights of the offsets 0, 1, ..., up to four sigma; their number is odd."""
    radius = int(np.ceil(4.0 * sigma))
    offsets = np.arange(radius + radius % 2 + 1)
    weights = np.exp(-0.5 * (offsets / sigma) ** 2) * (offsets <= radius)
    return (weights / (2.0 * weights.sum() - weights[0])).astype(np.float32)


def _find_extrema(levels: tuple[np.ndarray, ...], contrast_threshold: float) -> np.ndarray:
    contrast = contrast_threshold / space.SCALES
    found = np.empty((levels[0].size // 64 + 64, 4), np.float32)
    count = space.find_extrema(levels, np.float32(0.5 * contrast), contrast, _MOST_EDGE, found)
    if count > len(found):
        found = np.empty((count, 4), np.float32)
        space.find_extrema(levels, np.float32(0.5 * contrast), contrast, _MOST_EDGE, found)
    return found[:count].copy()


def _domain_sizes(count: int) -> Float64[np.ndarray, " k"]:
    """Relative sizes of the windows of a descriptor, evenly spaced in octaves; 1 if there is one."""
    return np.exp2(_POOLED_OCTAVES * np.linspace(-1.0, 1.0, count)) if count > 1 else np.ones(1)


def _describe(octave: _Octave, wanted: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns x, y, diameter and angle of the oriented features of an octave, and their descriptors."""
    extrema, sigma = octave.extrema[wanted], octave.sigma()[wanted]
    most = kernels.MOST_ORIENTATIONS * len(extrema)
    columns, descriptors = np.empty((most, 4), np.float32), np.empty((most, 128), np.uint8)
    count = kernels.describe_all(octave.levels, extrema, sigma, octave.pixel, sizes, columns, descriptors)
    return columns[:count], descriptors[:count]


@checked
def describe_upright(
    gray: UInt8[np.ndarray, "h w"], pixels: Float64[np.ndarray, "n 2"], sigma_px: float = 5.0
) -> UInt8[np.ndarray, "n 128"]:
    """Root-SIFT of unrotated windows of one size, for corners of a camera that stays upright.

    Work: one blur of the image, and 900 samples per window.

    Args:
        gray: the image.
        pixels: window centers; parts of a window outside the image replicate its border.
        sigma_px: scale; a window's side is 12 times this.

    Raises:
        ConfigError: sigma_px is not positive.
        ShapeError: a pixel is not finite.
    """
    if not 0 < sigma_px < 1000:
        raise ConfigError(f"sigma_px must be positive, and less than 1000, got {sigma_px}")
    if not np.isfinite(pixels).all():
        raise ShapeError("pixels must be finite")
    descriptors = np.zeros((len(pixels), 128), np.uint8)
    if len(pixels) and min(gray.shape) >= 2:
        # The samples are 0.75 sigma apart: blurred by about half of that, they do not alias.
        level = _blurred(gray.astype(np.float32), 0.4 * sigma_px)
        kernels.describe_upright(level, np.ascontiguousarray(pixels), float(sigma_px), descriptors)
    return descriptors


@checked
def root_sift(descriptors: Float32[np.ndarray, "n 128"]) -> UInt8[np.ndarray, "n 128"]:
    """L1-normalized SIFT to root-SIFT: 512 times the square root, as bytes (Arandjelovic and Zisserman, CVPR 2012).

    For descriptors computed elsewhere; `detect_sift` already returns root-SIFT.
    """
    values = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)
    return np.minimum(np.rint(512.0 * np.sqrt(values)), 255).astype(np.uint8)
