"""Disparities of a rectified pair by semi-global matching."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Int16, UInt8, UInt16

from epipole import _parallel
from epipole._checks import as_image
from epipole.config import options_of
from epipole.disparity_search import _block_kernels as block_kernels
from epipole.disparity_search import _consistency_kernels as consistency
from epipole.disparity_search import _path_kernels as kernels
from epipole.disparity_search._simd_kernels import LANES
from epipole.disparity_search.coarse_to_fine import MARGIN_PX, TILE_PX, tiles_of
from epipole.disparity_search.config import DisparityConfig
from epipole.disparity_search.uncertainty import MatchEvidence, disparity_sigma, roughness
from epipole.errors import ConfigError, ShapeError
from epipole.image import census
from epipole.scene import DisparityMap, StereoReason

_MARGIN = 32  # rows beyond a strip in which its paths start; more do not change the result (measured)
_MOST_STRIP_BYTES = 1 << 27
_LEAST_ROWS, _MOST_ROWS = 16, 192
_ROWS = 64  # at a time, in pixelwise operations
_MOST_DISPARITIES = 4096
_COARSE = 4  # downscaling factor of the images for estimating the range
_LEAST_CHANGE, _TEXTURE_WINDOW = 3, 25  # of 255 gray levels; pixels
_FEW_DISPARITIES = 48  # fewer are always searched in full
_SMOOTH_PX = 1.0  # largest difference between neighbors of a region


@dataclass(frozen=True, slots=True, eq=False)
class _Image:
    bits: UInt8[np.ndarray, "h w planes"]
    """Census. The Hamming distance is independent of the order of the bits, so that of a mirrored image is the mirrored one."""
    brightness: Int16[np.ndarray, "h w"]
    """0 to 255."""

    def mirrored(self) -> _Image:
        """Mirrored horizontally."""
        return _Image(
            np.ascontiguousarray(self.bits[:, ::-1]), np.ascontiguousarray(self.brightness[:, ::-1])
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Winners:
    """Best disparities of one image, and their cues."""

    disparity: Float32[np.ndarray, "h w"]
    lowest: UInt16[np.ndarray, "h w"]
    second: UInt16[np.ndarray, "h w"]
    """The lowest sum that is neither the lowest nor adjacent to it."""
    steepness: Float32[np.ndarray, "h w"]
    """Slope of the fitted V."""
    spread: UInt16[np.ndarray, "h w"]
    """Difference between the winners of the downward and the upward sweep."""
    other: Float32[np.ndarray, "h2 w2"]
    """Integer disparities of the other image from the same sums; NaN for none. Empty if not requested."""


def match_stereo(left: Any, right: Any, config: DisparityConfig | None = None) -> DisparityMap:
    """Disparities of a rectified pair by semi-global matching of census windows (Hirschmueller, PAMI 2008).

    Costs are summed along straight paths; the disparity with the lowest sum is refined by fitting a V to its neighbors' sums
    (Haller and Nedevschi, TIP 2012). Pixels that the other image does not confirm are unknown. Extra memory: 128 MB or 16 rows of sums
    (2 bytes per pixel and disparity) per thread.

    Args:
        left: (h, w) or (h, w, 3), 8 or 16 bits; rows are epipolar lines.
        right: the same size.
        config: options; None for the defaults.

    Raises:
        ShapeError: the images have different sizes or unsupported types.
        ConfigError: the disparity range does not fit the images.
    """
    return match_with_evidence(left, right, config)[0]


def match_with_evidence(
    left: Any, right: Any, config: DisparityConfig | None = None
) -> tuple[DisparityMap, MatchEvidence]:
    """`match_stereo`, and the cues behind its standard deviations."""
    config = options_of(DisparityConfig, config)
    one, two = _gray_pair(left, right)
    low, high = _search_range(one, two, config)
    if config.left_right == "accurate":
        mine, mirrored = _both_winners(one, two, low, high, config)
        theirs = mirrored.disparity[:, ::-1]
    else:
        mine = _winners(_inspect(one, config), _inspect(two, config), low, high, config)
        theirs = mine.other
    blank = _parallel.map_chunks(lambda k, *_: _is_textureless((one, two)[k]), 2, 2)
    apart, reason = _checked(mine, theirs, low, config, (blank[0], blank[1]))
    disparity = cv2.medianBlur(mine.disparity, config.median_px) if config.median_px else mine.disparity
    reason[_speckles(disparity, reason, config.min_region_px)] = StereoReason.SPECKLE
    smoothing = np.abs(disparity - mine.disparity)
    per_path = np.float32(8.0 / config.paths)  # sums are proportional to the number of paths
    margin = per_path * (mine.second.astype(np.float32) - mine.lowest)
    evidence = MatchEvidence(
        per_path * mine.steepness, margin, apart, smoothing, mine.spread, roughness(disparity)
    )
    sigma = disparity_sigma(evidence)
    if config.max_sigma_px is not None:
        reason[(reason == StereoReason.OK) & (sigma > config.max_sigma_px)] = StereoReason.UNCERTAIN
    known, nan = reason == StereoReason.OK, np.float32(np.nan)
    sigma = np.where(known, sigma, nan)
    return DisparityMap(np.where(known, disparity, nan), sigma, reason), evidence


def _gray_pair(left: Any, right: Any) -> tuple[UInt16[np.ndarray, "h w"], UInt16[np.ndarray, "h w"]]:
    """Both images as gray; a gray image can be paired with a color one."""
    grays = []
    for name, image in (("left", left), ("right", right)):
        array = as_image(image, name)
        if array.size == 0:
            raise ShapeError(f"{name} is empty: {array.shape}")
        if array.ndim == 3 and array.shape[2] == 3 and array.dtype in (np.uint8, np.uint16):
            array = cv2.cvtColor(array, cv2.COLOR_RGB2GRAY)
        if array.ndim != 2 or array.dtype not in (np.uint8, np.uint16):
            raise ShapeError(
                f"{name} must be (h, w) or (h, w, 3) with 8 or 16 bits, got {array.shape} of {array.dtype}"
            )
        grays.append(array.astype(np.uint16))
    if grays[0].shape != grays[1].shape:
        (h1, w1), (h2, w2) = grays[0].shape, grays[1].shape
        raise ShapeError(
            f"left is {w1} x {h1} pixels and right {w2} x {h2}: the images of a rectified pair must have the same size"
        )
    if min(grays[0].shape) < 1:
        raise ShapeError("the images are empty")
    return grays[0], grays[1]


def _search_range(left: np.ndarray, right: np.ndarray, config: DisparityConfig) -> tuple[int, int]:
    low, high, width = config.min_disparity_px, config.max_disparity_px, left.shape[1]
    if low >= width or (high is not None and high <= -width):
        raise ConfigError(f"the disparity range from {low} does not fit images {width} pixels wide")
    if high is None:
        high = max(_largest_disparity(left, right, config), low + 1)
    high = min(high, width - 1)
    if high - low >= _MOST_DISPARITIES:
        raise ConfigError(
            f"{high - low + 1} disparities exceed the maximum of {_MOST_DISPARITIES}: reduce the range"
        )
    return low, high


def _largest_disparity(left: np.ndarray, right: np.ndarray, config: DisparityConfig) -> int:
    """The 99.8th percentile of the disparities at a quarter of the resolution, with a margin."""
    size = (max(1, left.shape[1] // _COARSE), max(1, left.shape[0] // _COARSE))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right)]
    low, high = config.min_disparity_px // _COARSE, max(size[0] // 2, config.min_disparity_px // _COARSE + 1)
    found = _winners(_inspect(small[0], config), _inspect(small[1], config), low, high, config)
    seen = _checked(found, found.other, low, config)[1] == StereoReason.OK
    if not seen.any():
        return left.shape[1] // 4
    scale = left.shape[1] / size[0]
    return int(np.ceil(scale * (float(np.quantile(found.disparity[seen], 0.998)) + 2.0)))


def _inspect(gray: UInt16[np.ndarray, "h w"], config: DisparityConfig) -> _Image:
    gray = np.ascontiguousarray(gray)
    return _Image(census(gray, config.window), _brightness(gray))


def _winners(
    left: _Image, right: _Image, low: int, high: int, config: DisparityConfig, *, with_other: bool = True
) -> _Winners:
    height, width = left.brightness.shape
    count = high - low + 1
    depth = -(-count // LANES) * LANES
    padding = depth + abs(low)
    planes = left.bits.shape[2]
    reversed_bits = np.zeros((height, planes, width + 2 * padding), np.uint8)
    reversed_bits[:, :, padding : padding + width] = right.bits[:, ::-1].transpose(0, 2, 1)
    of_other = (height, width) if with_other else (0, 0)
    winner, lowest, second, spread = (np.empty((height, width), np.uint16) for _ in range(4))
    beside, other = np.empty((height, width, 2), np.uint16), np.empty(of_other, np.uint16)
    out = (winner, lowest, second, beside, spread, other)
    size, search = (height, width, planes, padding), (low, count, depth)
    images = (
        left.bits.reshape(-1),
        reversed_bits.reshape(-1),
        *_blended(left.brightness, right.brightness, padding, config.brightness_cost),
    )
    rows = int(np.clip(_MOST_STRIP_BYTES // (2 * width * depth), _LEAST_ROWS, _MOST_ROWS))
    num_strips = -(-height // rows)
    if config.method == "block":
        _parallel.map_chunks(
            lambda start, stop, _: block_kernels.match_blocks(
                images, size, search, config.block_px // 2, start, stop, out
            ),
            height,
            num_strips,
        )
    else:
        _match_paths(images, left.brightness, size, search, config, num_strips, out)
    disparity, steepness = (np.empty((height, width), np.float32) for _ in range(2))
    others = np.empty(of_other, np.float32)
    _by_rows(
        height,
        lambda start, stop, _: consistency.bottom_of_v(
            winner, lowest, beside, other, low, start, stop, (disparity, steepness, others)
        ),
    )
    return _Winners(disparity, lowest, second, steepness, spread, others)


def _both_winners(
    left: np.ndarray, right: np.ndarray, low: int, high: int, config: DisparityConfig
) -> tuple[_Winners, _Winners]:
    """Winners of the left image, and of the mirrored right image matched to the mirrored left one.

    Coarse to fine, the consistent disparities at half resolution determine the search range of each tile.
    """
    height, width = left.shape
    is_small = high - low < _FEW_DISPARITIES or min(height, width) < 2 * TILE_PX
    if config.search == "full" or is_small:
        one, two = _inspect(left, config), _inspect(right, config)
        mine = _winners(one, two, low, high, config, with_other=False)
        return mine, _winners(two.mirrored(), one.mirrored(), low, high, config, with_other=False)
    size = (width // 2, height // 2)
    half = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right)]
    coarse = _both_winners(half[0], half[1], low // 2, -(-high // 2), config)
    mirrored = right[:, ::-1], left[:, ::-1]
    out = []
    for pair, mine, theirs in (((left, right), *coarse), (mirrored, *coarse[::-1])):
        _, reason = _checked(mine, theirs.disparity[:, ::-1], low // 2, config)
        reason[_speckles(mine.disparity, reason, config.min_region_px)] = StereoReason.SPECKLE
        trusted = np.where(reason == StereoReason.OK, mine.disparity, np.float32(np.nan))
        out.append(_winners_by_tiles(*pair, trusted, (low, high), config))
    return out[0], out[1]


def _winners_by_tiles(
    left: np.ndarray, right: np.ndarray, coarse: np.ndarray, search: tuple[int, int], config: DisparityConfig
) -> _Winners:
    """`_winners` of every tile in its own range.

    A tile is cropped with a margin, extended to the left by the length of its range so that its matches are inside.
    """
    height, width = left.shape
    out = _Winners(
        np.empty(left.shape, np.float32),
        np.empty(left.shape, np.uint16),
        np.empty(left.shape, np.uint16),
        np.empty(left.shape, np.float32),
        np.empty(left.shape, np.uint16),
        np.empty((0, 0), np.float32),
    )
    for tile in tiles_of(coarse, (height, width), search):
        (top, bottom), (start, end), (first, last) = tile.rows, tile.columns, tile.disparities
        y0, y1 = max(top - MARGIN_PX, 0), min(bottom + MARGIN_PX, height)
        x0, x1 = max(start - MARGIN_PX - (last - first), 0), min(end + MARGIN_PX, width)
        # Column x - first of the right image corresponds to x of the left one: the range starts at zero.
        shifted = np.clip(np.arange(x0, x1) - first, 0, width - 1)
        here, there = _inspect(left[y0:y1, x0:x1], config), _inspect(right[y0:y1][:, shifted], config)
        found = _winners(here, there, 0, last - first, config, with_other=False)
        inside = np.s_[top - y0 : bottom - y0, start - x0 : end - x0]
        whole = np.s_[top:bottom, start:end]
        out.disparity[whole] = found.disparity[inside] + np.float32(first)
        for name in ("lowest", "second", "steepness", "spread"):
            getattr(out, name)[whole] = getattr(found, name)[inside]
    return out


def _match_paths(
    images: tuple[Any, ...],
    brightness: np.ndarray,
    size: tuple[int, int, int, int],
    search: tuple[int, int, int],
    config: DisparityConfig,
    num_strips: int,
    out: tuple[np.ndarray, ...],
) -> None:
    height, width, depth = size[0], size[1], search[2]
    steps = np.arange(256)
    jumps = np.rint(config.small_penalty * (1.0 + config.edge_penalty * np.exp(-steps / config.edge_fade)))
    penalties = (config.paths, config.small_penalty, jumps.astype(np.int64))
    mine = threading.local()  # allocating memory for every strip would take a fifth of the time

    def match(start: int, stop: int, _: int) -> None:
        if not hasattr(mine, "sums"):
            mine.sums = np.empty(-(-height // num_strips) * width * depth, np.uint16)
        kernels.match_strip(images, brightness, size, search, penalties, start, stop, _MARGIN, mine.sums, out)

    _parallel.map_chunks(match, height, num_strips)


def _blended(
    left: np.ndarray, right: np.ndarray, padding: int, most: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """Brightness as bytes, mirrored for the right image; dummies if `most` is 0."""
    if not most:
        return np.zeros(1, np.uint8), np.zeros(1, np.uint8), 0
    height, width = right.shape
    mirrored = np.zeros((height, width + 2 * padding), np.uint8)
    mirrored[:, padding : padding + width] = right[:, ::-1]
    return left.astype(np.uint8).reshape(-1), mirrored.reshape(-1), most


def _brightness(gray: UInt16[np.ndarray, "h w"]) -> np.ndarray:
    """Brightness from 0 to 255; 16-bit images are scaled from their 0.5th to 99.5th percentile."""
    if gray.max(initial=0) <= 255:
        return gray.astype(np.int16)
    low, high = np.percentile(gray, (0.5, 99.5))
    return np.clip((gray - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.int16)


def _checked(
    mine: _Winners,
    theirs: Float32[np.ndarray, "h w"],
    low: int,
    config: DisparityConfig,
    blank: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[Float32[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """Difference of each disparity from that of the matched pixel in the other image, and reasons before the speckle filter.

    blank: textureless pixels of both images; None: not checked.
    """
    shape = mine.disparity.shape
    nowhere = np.zeros(shape, bool)
    apart, reason = np.empty(shape, np.float32), np.empty(shape, np.uint8)
    found, theirs = (mine.disparity, mine.lowest, mine.second), np.ascontiguousarray(theirs)
    limits = (float(config.min_margin), float(config.max_left_right_px))
    _by_rows(
        shape[0],
        lambda start, stop, _: consistency.check_rows(
            found, theirs, blank or (nowhere, nowhere), low, limits, start, stop, (apart, reason)
        ),
    )
    return apart, reason


def _by_rows(height: int, work: Callable[[int, int, int], None]) -> None:
    _parallel.map_chunks(work, height, -(-height // _ROWS))


def _is_textureless(gray: UInt16[np.ndarray, "h w"]) -> np.ndarray:
    """Pixels in whose window no pixel differs from its row neighbors by more than noise."""
    bright = _brightness(gray)
    changes = np.zeros(bright.shape, np.uint8)
    changes[:, 1:-1] = np.abs(bright[:, 2:] - bright[:, :-2]) >= _LEAST_CHANGE
    return cv2.dilate(changes, np.ones((_TEXTURE_WINDOW, _TEXTURE_WINDOW))) == 0


def _speckles(disparity: np.ndarray, reason: np.ndarray, least: int) -> np.ndarray:
    """Pixels of connected regions of similar disparity smaller than `least`."""
    if least <= 1:
        return np.zeros(disparity.shape, bool)
    known = reason == StereoReason.OK
    sixteenths = np.where(known, np.rint(16.0 * disparity), -32768.0).astype(np.int16)
    cv2.filterSpeckles(sixteenths, -32768, min(least - 1, reason.size), 16.0 * _SMOOTH_PX)
    return known & (sixteenths == -32768)
