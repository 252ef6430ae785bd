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

_MARGIN = 32  # rows beyond a strip in which its paths begin: later ones do not change the result (measured)
_MOST_STRIP_BYTES = 1 << 27
_LEAST_ROWS, _MOST_ROWS = 16, 192
_ROWS = 64  # at a time, of what is done pixel by pixel
_MOST_DISPARITIES = 4096
_COARSE = 4  # times smaller are the images from which the range is found
_LEAST_CHANGE, _TEXTURE_WINDOW = 3, 25  # of 255 grey levels; pixels
_FEW_DISPARITIES = 48  # are searched in full
_SMOOTH_PX = 1.0  # neighbours of one region differ by no more


@dataclass(frozen=True, slots=True, eq=False)
class _Image:
    """What matching compares."""

    bits: UInt8[np.ndarray, "h w planes"]
    """Census. Windows differ in as many bits whatever the bits' order: that of a mirrored image is the mirrored one."""
    brightness: Int16[np.ndarray, "h w"]
    """0 to 255."""

    def mirrored(self) -> _Image:
        """With left and right exchanged."""
        return _Image(
            np.ascontiguousarray(self.bits[:, ::-1]), np.ascontiguousarray(self.brightness[:, ::-1])
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Winners:
    """What the sums of one image say."""

    disparity: Float32[np.ndarray, "h w"]
    lowest: UInt16[np.ndarray, "h w"]
    second: UInt16[np.ndarray, "h w"]
    """The lowest but for the lowest and its neighbours."""
    steepness: Float32[np.ndarray, "h w"]
    """Of the V."""
    spread: UInt16[np.ndarray, "h w"]
    """How far apart the winners of the downward and the upward sweep lie."""
    other: Float32[np.ndarray, "h2 w2"]
    """Disparities of the other image read off the same sums, whole; NaN where there is none. Empty if not asked for."""


def match_stereo(left: Any, right: Any, config: DisparityConfig | None = None) -> DisparityMap:
    """Disparities of a rectified pair by semi-global matching of census windows (Hirschmueller, PAMI 2008).

    Every step is a line of `match_with_evidence`. A disparity is whole where the costs, summed along straight paths, are lowest, plus the
    V through its neighbours' sums (Haller and Nedevschi, TIP 2012); what the other image does not confirm is
    unknown. Memory beside the images' own: 128 MB or 16 rows of sums (2 bytes for each pixel and disparity) per thread.

    Args:
        left: (h, w) or (h, w, 3), 8 or 16 bits; rows are epipolar lines.
        right: the same size.
        config: options; None for the defaults.

    Raises:
        ShapeError: the images are no pair.
        ConfigError: the range of disparities does not fit the images.
    """
    return match_with_evidence(left, right, config)[0]


def match_with_evidence(
    left: Any, right: Any, config: DisparityConfig | None = None
) -> tuple[DisparityMap, MatchEvidence]:
    """`match_stereo`, and what its standard deviations were read from."""
    config = options_of(DisparityConfig, config)
    one, two = _grey_pair(left, right)
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
    per_path = np.float32(8.0 / config.paths)  # half as many paths make sums half as large
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


def _grey_pair(left: Any, right: Any) -> tuple[UInt16[np.ndarray, "h w"], UInt16[np.ndarray, "h w"]]:
    """Both images with one channel; a grey one may go with a coloured one."""
    greys = []
    for name, image in (("left", left), ("right", right)):
        array = as_image(image, name)
        if array.size == 0:
            raise ShapeError(f"{name} is empty: {array.shape}")
        if array.ndim == 3 and array.shape[2] == 3 and array.dtype in (np.uint8, np.uint16):
            array = cv2.cvtColor(array, cv2.COLOR_RGB2GRAY)
        if array.ndim != 2 or array.dtype not in (np.uint8, np.uint16):
            raise ShapeError(
                f"{name} must be (h, w) or (h, w, 3) of 8 or 16 bits, is {array.shape} of {array.dtype}"
            )
        greys.append(array.astype(np.uint16))
    if greys[0].shape != greys[1].shape:
        (h1, w1), (h2, w2) = greys[0].shape, greys[1].shape
        raise ShapeError(f"left is {w1} x {h1} pixels and right {w2} x {h2}: a rectified pair has one size")
    if min(greys[0].shape) < 1:
        raise ShapeError("the images are empty")
    return greys[0], greys[1]


def _search_range(left: np.ndarray, right: np.ndarray, config: DisparityConfig) -> tuple[int, int]:
    """First and last disparity to look for."""
    low, high, width = config.min_disparity_px, config.max_disparity_px, left.shape[1]
    if low >= width or (high is not None and high <= -width):
        raise ConfigError(f"no disparity from {low} on exists in images {width} pixels wide")
    if high is None:
        high = max(_largest_disparity(left, right, config), low + 1)
    high = min(high, width - 1)
    if high - low >= _MOST_DISPARITIES:
        raise ConfigError(
            f"{high - low + 1} disparities are more than the {_MOST_DISPARITIES} that can be told apart"
        )
    return low, high


def _largest_disparity(left: np.ndarray, right: np.ndarray, config: DisparityConfig) -> int:
    """What all but the nearest two in a thousand pixels have, from images a quarter as large."""
    size = (max(1, left.shape[1] // _COARSE), max(1, left.shape[0] // _COARSE))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right)]
    low, high = config.min_disparity_px // _COARSE, max(size[0] // 2, config.min_disparity_px // _COARSE + 1)
    found = _winners(_inspect(small[0], config), _inspect(small[1], config), low, high, config)
    seen = _checked(found, found.other, low, config)[1] == StereoReason.OK
    if not seen.any():
        return left.shape[1] // 4
    scale = left.shape[1] / size[0]
    return int(np.ceil(scale * (float(np.quantile(found.disparity[seen], 0.998)) + 2.0)))


def _inspect(grey: UInt16[np.ndarray, "h w"], config: DisparityConfig) -> _Image:
    grey = np.ascontiguousarray(grey)
    return _Image(census(grey, config.window), _brightness(grey))


def _winners(
    left: _Image, right: _Image, low: int, high: int, config: DisparityConfig, *, with_other: bool = True
) -> _Winners:
    """Disparities of the left image, from sums along the paths or over blocks."""
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
    """Of the left image, and of the mirrored right one whose left is the mirrored left one.

    Coarse to fine, what agrees in images of half the size tells each tile where to search.
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

    A tile is cut out with a margin and, to the left, as many columns as its range is long, so that its matches are inside.
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
        # x - first of the right image beside x of the left one: the range begins at zero.
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
    mine = threading.local()  # fresh memory for every strip would cost a fifth of the time

    def match(start: int, stop: int, _: int) -> None:
        if not hasattr(mine, "sums"):
            mine.sums = np.empty(-(-height // num_strips) * width * depth, np.uint16)
        kernels.match_strip(images, brightness, size, search, penalties, start, stop, _MARGIN, mine.sums, out)

    _parallel.map_chunks(match, height, num_strips)


def _blended(
    left: np.ndarray, right: np.ndarray, padding: int, most: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """Brightness as bytes, that of the right image from right to left; nothing where it is not asked for."""
    if not most:
        return np.zeros(1, np.uint8), np.zeros(1, np.uint8), 0
    height, width = right.shape
    mirrored = np.zeros((height, width + 2 * padding), np.uint8)
    mirrored[:, padding : padding + width] = right[:, ::-1]
    return left.astype(np.uint8).reshape(-1), mirrored.reshape(-1), most


def _brightness(grey: UInt16[np.ndarray, "h w"]) -> np.ndarray:
    """0 ... 255 from the darkest to the brightest, whatever the depth of the image."""
    if grey.max(initial=0) <= 255:
        return grey.astype(np.int16)
    low, high = np.percentile(grey, (0.5, 99.5))
    return np.clip((grey - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.int16)


def _checked(
    mine: _Winners,
    theirs: Float32[np.ndarray, "h w"],
    low: int,
    config: DisparityConfig,
    blank: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[Float32[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """How far each disparity is from that of the matched pixel in the other image, and reasons before speckles are looked at.

    blank: where nothing changes along the row, of both images; None: not looked at.
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


def _is_textureless(grey: UInt16[np.ndarray, "h w"]) -> np.ndarray:
    """Where no pixel of a window differs from its neighbours in the row by more than what noise does."""
    bright = _brightness(grey)
    changes = np.zeros(bright.shape, np.uint8)
    changes[:, 1:-1] = np.abs(bright[:, 2:] - bright[:, :-2]) >= _LEAST_CHANGE
    return cv2.dilate(changes, np.ones((_TEXTURE_WINDOW, _TEXTURE_WINDOW))) == 0


def _speckles(disparity: np.ndarray, reason: np.ndarray, least: int) -> np.ndarray:
    """Pixels of regions that are smaller than `least`, whose neighbours differ by no more than a pixel."""
    if least <= 1:
        return np.zeros(disparity.shape, bool)
    known = reason == StereoReason.OK
    sixteenths = np.where(known, np.rint(16.0 * disparity), -32768.0).astype(np.int16)
    cv2.filterSpeckles(sixteenths, -32768, min(least - 1, reason.size), 16.0 * _SMOOTH_PX)
    return known & (sixteenths == -32768)
