"""Exhaustive nearest-neighbor matching with ratio test and mutual check."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int32, UInt8

from epipole._checks import checked
from epipole.config import MatchConfig, options_of
from epipole.errors import ConfigError, ShapeError
from epipole.features import _byte_dot_kernels as byte_kernels
from epipole.features import _matching_kernels as kernels
from epipole.features.features import Features
from epipole.features.kinds import SIFT, Matcher, Metric, kind_of

_BLOCK_ROWS = 256
_STRIP_PX = 32.0  # width of the strips in which features along a line are looked up
_CELL_PX = 8.0  # length of the cells of a strip
_MOST_CELLS = 1 << 26
_FARTHEST_PX = 1e9
"""Pixels beyond it are in no image, and would overflow the number of a cell."""
_UNIT = 512.0
"""Length of a root-SIFT descriptor."""


@checked
def match_descriptors(
    descriptors1: UInt8[np.ndarray, "n d"],
    descriptors2: UInt8[np.ndarray, "m e"],
    config: MatchConfig | None = None,
) -> Int32[np.ndarray, "k 2"]:
    """Index pairs of mutual nearest neighbors that pass the ratio test (Lowe, IJCV 2004, section 7.1).

    The width determines the kind of descriptor (root-SIFT, ORB), and the kind how they are compared.

    Raises:
        ShapeError: descriptors have different or unknown widths.
    """
    config = options_of(MatchConfig, config)
    width, other = descriptors1.shape[1], descriptors2.shape[1]
    if width != other:
        raise ShapeError(f"cannot match descriptors of widths {width} and {other}")
    matcher = MATCHERS[kind_of(descriptors1).metric]
    if min(len(descriptors1), len(descriptors2)) == 0:
        return np.empty((0, 2), np.int32)
    return matcher(descriptors1, descriptors2, config)


def match_by_angle(first: np.ndarray, second: np.ndarray, config: MatchConfig) -> np.ndarray:
    """Mutual nearest neighbors by angle, by products of whole numbers where the processor has them."""
    top_two = _top_two_bytes if _fits_byte_dot(first, second) else _top_two_floats
    best = top_two(first, second, config)
    return _accept(best[0], best[1], best[2], best[3], config)


TopTwo = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""For every row the best column, the best and the second best similarity; for every column the best."""


def _fits_byte_dot(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether the processor has products of whole numbers, and no similarity overflows the keys (root-SIFT never does)."""
    if byte_kernels.LANES == 0 or len(b) > byte_kernels.MOST_COLUMNS:
        return False
    longest = [float(byte_kernels.most_squared_length(d)) for d in (a, b)]
    return longest[0] * longest[1] < float(byte_kernels.MOST_SIMILARITY) ** 2


def _top_two_bytes(a: np.ndarray, b: np.ndarray, _config: MatchConfig) -> TopTwo:
    """Work: 128 * n * m products, 64, 32 or (without VNNI) 16 per instruction; the similarities stay in registers."""
    n, m = len(a), len(b)
    rows = np.empty(
        (-(-n // byte_kernels.ROWS), byte_kernels.ROWS, byte_kernels.WIDTH), byte_kernels.ROW_TYPE
    )
    layout = (-(-m // byte_kernels.COLUMNS), byte_kernels.STEPS, byte_kernels.COLUMNS, byte_kernels.GROUP)
    columns = np.empty(layout, byte_kernels.COLUMN_TYPE)
    bias = np.empty((len(columns), byte_kernels.COLUMNS), np.uint32)
    byte_kernels.pack_rows(a, rows)
    byte_kernels.pack_columns(b, columns, bias)
    best, second = np.empty(rows.shape[:2], np.uint32), np.empty(rows.shape[:2], np.uint32)
    column, column_best = np.empty(rows.shape[:2], np.int32), np.zeros(bias.shape, np.uint32)
    byte_kernels.byte_top_two(
        rows,
        columns,
        bias,
        best.ravel(),
        second.ravel(),
        column.ravel(),
        column_best,
    )
    return column.ravel()[:n], best.ravel()[:n], second.ravel()[:n], column_best.ravel()[:m]


def _top_two_floats(a: np.ndarray, b: np.ndarray, config: MatchConfig) -> TopTwo:
    """The same with float32 products, in blocks of rows that fit the cache; integers below 2^24 are exact.

    Columns are computed only for rows that pass the ratio test; -1 for the others.
    """
    a, b = a.astype(np.float32), b.astype(np.float32)
    n, m = len(a), len(b)
    block = np.empty((min(_BLOCK_ROWS, n), m), np.float32)
    best, second = np.empty(n, np.float32), np.empty(n, np.float32)
    column, column_best = np.full(n, -1, np.int32), np.full(m, -1.0, np.float32)
    for start in range(0, n, _BLOCK_ROWS):
        stop = min(start + _BLOCK_ROWS, n)
        here, rows = slice(start, stop), stop - start
        np.dot(a[here], b.T, out=block[:rows])
        kernels.top_two(block, rows, best[here], second[here], column_best)
        kernels.find_best_column(
            block, rows, best[here], _passes(best[here], second[here], config), column[here]
        )
    return column, best, second, column_best


def _passes(best: np.ndarray, second: np.ndarray, config: MatchConfig) -> np.ndarray:
    nearest, next_nearest = _angle(best), _angle(second)
    return (nearest < config.max_ratio * next_nearest) & (nearest <= config.max_distance)


def _accept(
    column: np.ndarray, best: np.ndarray, second: np.ndarray, column_best: np.ndarray, config: MatchConfig
) -> Int32[np.ndarray, "k 2"]:
    """Ratio test, distance and mutual check."""
    rows1 = np.flatnonzero((column >= 0) & _passes(best, second, config))
    mutual = best[rows1] == column_best[column[rows1]]
    return _one_to_one(rows1[mutual], column[rows1[mutual]])


@checked
def match_along_epipolar_lines(
    features1: Features,
    features2: Features,
    fundamental: Float64[np.ndarray, "3 3"],
    band_px: float,
    config: MatchConfig | None = None,
) -> Int32[np.ndarray, "k 2"]:
    """Mutual nearest SIFT neighbors among the features within `band_px` of each other's epipolar line.

    A line passes about one hundredth of an image's features, so this costs a fraction of exhaustive matching. The ratio
    test compares candidates near the line only.

    Args:
        features1: features of image 1.
        features2: features of image 2.
        fundamental: x2^T F x1 = 0, pixels.
        band_px: half width of the band around a line.
        config: ratio and distance bounds.

    Raises:
        ShapeError: features are not SIFT, or have pixels outside any image.
        ConfigError: band_px is not positive and finite.
    """
    config = options_of(MatchConfig, config)
    if not 0 < band_px < np.inf:
        raise ConfigError(f"band_px must be positive and finite, got {band_px}")
    _require_sift(features1, "features1")
    _require_sift(features2, "features2")
    n, m = len(features1), len(features2)
    if min(n, m) == 0:
        return np.empty((0, 2), np.int32)
    column, best, second = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    column_best = np.full(m, -1, np.int32)
    kernels.guided_top_two(
        features1.pixels.astype(np.float64),
        features1.descriptors,
        _cells(features2, 0),
        _cells(features2, 1),
        np.ascontiguousarray(fundamental),
        float(band_px),
        _STRIP_PX,
        _CELL_PX,
        column,
        best,
        second,
        column_best,
    )
    return _accept(column, best, second, column_best, config)


@checked
def match_near_pixels(
    pixels: Float64[np.ndarray, "p 2"],
    descriptors: UInt8[np.ndarray, "p 128"],
    features: Features,
    radius_px: float,
    config: MatchConfig | None = None,
) -> tuple[Int32[np.ndarray, "k 2"], Float64[np.ndarray, " k"]]:
    """Match predicted pixels with SIFT features nearby: mutual best, with the ratio test among those within the radius.

    Args:
        pixels: where a feature is expected.
        descriptors: what it should look like.
        features: the features of the image.
        radius_px: largest distance from the expected pixel.
        config: ratio and distance bounds.

    Returns:
        Rows (prediction, feature), and the angle between their descriptors in radians.

    Raises:
        ShapeError: the features are not SIFT, or have pixels outside any image.
        ConfigError: radius_px is not positive and finite.
    """
    config = options_of(MatchConfig, config)
    if not 0 < radius_px < np.inf:
        raise ConfigError(f"radius_px must be positive and finite, got {radius_px}")
    _require_sift(features, "features")
    n, m = len(pixels), len(features)
    if min(n, m) == 0:
        return np.empty((0, 2), np.int32), np.empty(0)
    column, best, second = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    column_best = np.full(m, -1, np.int32)
    is_near = (np.abs(pixels) < _FARTHEST_PX).all(axis=1, keepdims=True)  # False for NaN
    wanted = np.where(is_near, pixels, -np.inf)
    cells = _cells(features, 0)
    kernels.nearby_top_two(
        wanted, descriptors, cells, _STRIP_PX, _CELL_PX, float(radius_px), column, best, second, column_best
    )
    matches = _accept(column, best, second, column_best, config)
    return matches, _angle(best[matches[:, 0]])


def _require_sift(features: Features, name: str) -> None:
    if kind_of(features.descriptors) is not SIFT:
        raise ShapeError(
            f"{name} must be SIFT features with 128 columns, got {features.descriptors.shape[1]}"
        )
    if not np.isfinite(features.pixels).all():
        raise ShapeError(f"{name} must have finite pixels")


def _cells(features: Features, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Features in the order of the cells of the strips along `axis`, and the first of each cell."""
    pixels = features.pixels.astype(np.float64)
    strip = np.maximum(pixels[:, axis] // _STRIP_PX, 0).astype(np.int64)
    cell = np.maximum(pixels[:, 1 - axis] // _CELL_PX, 0).astype(np.int64)
    strips, cells = int(strip.max()) + 1, int(cell.max()) + 1
    if strips * cells > _MOST_CELLS:
        raise ShapeError(f"features have pixels up to {pixels.max():.3g}, which no image has")
    key = strip * cells + cell
    order = np.argsort(key, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(key, minlength=strips * cells))])
    first = starts[np.arange(strips)[:, None] * cells + np.arange(cells + 1)]
    return order, pixels[order], features.descriptors[order], first


def _angle(similarity: np.ndarray) -> np.ndarray:
    return np.arccos(np.clip(similarity / (_UNIT * _UNIT), 0.0, 1.0))


def match_by_bits(first: np.ndarray, second: np.ndarray, config: MatchConfig) -> np.ndarray:
    """Mutual nearest neighbors by the number of bits that differ."""
    wide_a, wide_b = np.ascontiguousarray(first).view(np.uint64), np.ascontiguousarray(second).view(np.uint64)
    column, best, next_best = (np.empty(len(first), np.int64) for _ in range(3))
    column_best = np.full(len(second), 1 << 30, np.int64)
    kernels.hamming_top_two(wide_a, wide_b, column, best, next_best, column_best)
    passes = (best <= config.max_bits) & (best < config.max_ratio * next_best)
    rows1 = np.flatnonzero(passes & (best == column_best[column]))
    return _one_to_one(rows1, column[rows1])


def _one_to_one(rows1: np.ndarray, rows2: np.ndarray) -> np.ndarray:
    """Drop later rows with a column that is already taken (possible only for equal distances)."""
    _, first = np.unique(rows2, return_index=True)
    first.sort()
    return np.stack([rows1[first], rows2[first]], axis=1).astype(np.int32)


MATCHERS: dict[Metric, Matcher] = {Metric.ANGLE: match_by_angle, Metric.HAMMING: match_by_bits}
"""By the metric of the descriptors."""
