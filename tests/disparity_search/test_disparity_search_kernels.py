"""The loops over disparities against the same loops in Python, whose rows are NumPy's."""

from copy import deepcopy

import numpy as np
import pytest

import kernel_rows
from epipole._jit import kernel
from epipole.disparity_search import _block_kernels, _consistency_kernels, _path_kernels, search
from epipole.disparity_search._simd_kernels import LANES, count_bits, extend_paths, keep_lower, least_two
from epipole.disparity_search.config import DisparityConfig
from kernel_references import assert_same, assert_same_as_python, record_calls, reference_of


def matched(rng: np.random.Generator, shape: tuple[int, int], config: DisparityConfig) -> None:
    """Match a noisy pair whose disparity is three; every third column is repeated, so that sums tie."""
    height, width = shape
    wide = rng.integers(0, 255, (height, width + 3)).astype(np.uint16)
    wide[:, ::3] = 128
    left, right = wide[:, :width], wide[:, 3:]
    high = min(config.max_disparity_px or 0, width - 1)
    search._winners(
        search._inspect(left, config), search._inspect(right, config), config.min_disparity_px, high, config
    )


SHAPES = [(5, 21), (1, 1), (1, 9), (4, 1), (3, 40)]
RANGES = [(0, 20), (-6, 7), (5, 45)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("paths", [4, 8])
@reference_of(_path_kernels.match_strip)
def test_strips_of_paths(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int], paths: int
) -> None:
    calls = record_calls(monkeypatch, search, _path_kernels.match_strip)
    for low, high in RANGES:
        if low < shape[1]:
            brightness = 9 if low else 0
            matched(
                rng,
                shape,
                DisparityConfig(
                    min_disparity_px=low, max_disparity_px=high, paths=paths, brightness_cost=brightness
                ),
            )
    assert calls
    for *before, start, stop, margin, sums, out in calls:
        assert_same_as_python(_path_kernels.match_strip, *before, start, stop, margin, sums, out)
        if stop - start > 2:  # a strip within the image, with paths from one row beyond it
            assert_same_as_python(_path_kernels.match_strip, *before, start + 1, stop - 1, 1, sums, out)


@pytest.mark.parametrize("shape", SHAPES)
@reference_of(_block_kernels.match_blocks)
def test_strips_of_blocks(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]
) -> None:
    calls = record_calls(monkeypatch, search, _block_kernels.match_blocks)
    for (low, high), side in zip(RANGES, (5, 3, 15)):
        if low < shape[1]:
            config = DisparityConfig(
                min_disparity_px=low, max_disparity_px=high, method="block", block_px=side
            )
            matched(rng, shape, config)
    assert calls
    for arguments in calls:
        assert_same_as_python(_block_kernels.match_blocks, *arguments)


@pytest.mark.parametrize("with_other", [True, False])
@reference_of(_consistency_kernels.bottom_of_v)
def test_bottoms(rng: np.random.Generator, with_other: bool) -> None:
    shape = (4, 7)
    winner, lowest = (
        rng.integers(0, 12, shape).astype(np.uint16),
        rng.integers(0, 300, shape).astype(np.uint16),
    )
    beside = (lowest[..., None] + rng.integers(0, 2, (*shape, 2))).astype(np.uint16)  # flat bottoms too
    beside[0, ::2] = _path_kernels.NOBODY
    other = rng.integers(0, 12, shape if with_other else (0, 0)).astype(np.uint16)
    other[:1] = _path_kernels.NOBODY
    out = tuple(np.zeros(s, np.float32) for s in (shape, shape, other.shape))
    for rows in ((0, 4), (1, 3), (2, 2)):
        assert_same_as_python(_consistency_kernels.bottom_of_v, winner, lowest, beside, other, -3, *rows, out)


@reference_of(_consistency_kernels.check_rows)
def test_judgments(rng: np.random.Generator) -> None:
    shape = (6, 9)
    disparity, theirs = (rng.uniform(-4, 9, shape).astype(np.float32) for _ in range(2))
    theirs[1], theirs[2, ::2] = np.nan, np.inf
    disparity[3] = theirs[3] = 2.0
    disparity[4] = 1e6  # far out of the other image
    lowest = rng.integers(0, 300, shape).astype(np.uint16)
    second = (lowest + rng.integers(0, 3, shape)).astype(np.uint16)
    blank = (rng.random(shape) < 0.5, rng.random(shape) < 0.5)
    out = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    for rows, limits in (((0, 6), (0.0, 1.25)), ((2, 5), (0.2, 4.0)), ((3, 3), (0.0, 0.0))):
        assert_same_as_python(
            _consistency_kernels.check_rows,
            *((disparity, lowest, second), theirs, blank, 0, limits, *rows, out),
        )


@kernel
def combine(codes, costs, paths, at_before, least, jump, at_now, sums, more, best, winners, blocks):
    """Every instruction once; what they return."""
    count_bits(codes, 3, codes, 40, 70, 3, costs, 1, blocks)
    low = extend_paths(paths, at_before, least, jump, 20, costs, 1, at_now, sums, 2, blocks)
    found = least_two(sums, 2, more, 5, blocks)
    keep_lower(sums, 2, best, winners, 4, blocks)
    return low, found


def combine_by_numpy(codes, costs, paths, at_before, least, jump, at_now, sums, more, best, winners, blocks):
    kernel_rows.count_bits(codes, 3, codes, 40, 70, 3, costs, 1, blocks)
    low = kernel_rows.extend_paths(paths, at_before, least, jump, 20, costs, 1, at_now, sums, 2, blocks)
    found = kernel_rows.least_two(sums, 2, more, 5, blocks)
    kernel_rows.keep_lower(sums, 2, best, winners, 4, blocks)
    return low, found


@pytest.mark.parametrize("trial", range(8))
def test_rows_do_what_numpy_does(trial: int) -> None:
    """On any numbers, those at the ends of their types too, with ties, and with rows that begin anywhere."""
    rng = np.random.default_rng(trial)
    blocks = 1 + trial % 3
    count = blocks * LANES
    codes = rng.integers(0, 256, 500).astype(np.uint8)
    costs, out = np.zeros(count + 2, np.uint8), np.zeros(count + 3, np.uint16)
    paths = np.full(6 * (count + LANES), 255, np.uint8)
    at = [LANES + k * (count + LANES) for k in range(4)]
    for start in at[:2]:
        paths[start : start + count] = rng.integers(0, 256 if trial % 2 else 4, count)
    least = tuple(int(paths[start : start + count].min()) for start in at[:2])
    more = rng.integers(0, 6 if trial < 4 else 50_000, count + 6).astype(np.uint16)
    best = rng.integers(0, 65_536, count + 5).astype(np.uint16)
    winners = rng.integers(0, 65_536, count + 5).astype(np.uint16)
    arguments = (
        *(codes, costs, paths, tuple(at[:2]), least, (255 - trial, 30), tuple(at[2:]), out),
        *(more, best, winners, blocks),
    )
    ours, theirs = deepcopy(arguments), deepcopy(arguments)
    assert_same(combine(*ours), combine_by_numpy(*theirs))
    assert_same(ours, theirs)
