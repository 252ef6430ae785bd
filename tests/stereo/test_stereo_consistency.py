"""The consistency checks against the same statements over whole arrays."""

import numpy as np
import pytest

from epipole.disparity_search import _consistency_kernels as consistency
from epipole.disparity_search._path_kernels import NOBODY
from epipole.scene import StereoReason

SHAPE = (40, 57)


def bottom_by_arrays(winner, lowest, beside, other, low):
    down, up = (beside[..., k].astype(np.float32) - lowest for k in (0, 1))
    steepness = np.maximum(down, up)
    offset = 0.5 * (down - up) / np.maximum(steepness, 1.0)
    at_end = (beside == NOBODY).any(axis=2)
    offset = np.where(at_end, np.float32(0.0), offset)
    others = np.where(other == NOBODY, np.float32(np.nan), other + np.float32(low))
    return winner + offset + np.float32(low), np.where(at_end, np.minimum(down, up), steepness), others


def check_by_arrays(disparity, lowest, second, theirs, blank, low, limits):
    height, width = disparity.shape
    x = np.arange(width)
    matched = np.rint(x - disparity).astype(np.int64)
    inside = np.clip(matched, 0, width - 1)
    apart = np.abs(np.take_along_axis(theirs, inside, axis=1) - disparity)
    apart = np.where((matched >= 0) & (matched < width) & np.isfinite(apart), apart, np.float32(np.inf))
    reason = np.full((height, width), StereoReason.OK, np.uint8)
    reason[blank[0] | np.take_along_axis(blank[1], inside, axis=1)] = StereoReason.TEXTURELESS
    margin = second.astype(np.float32) - lowest
    reason[margin <= limits[0] * lowest] = StereoReason.AMBIGUOUS
    reason[~(apart <= limits[1])] = StereoReason.OCCLUDED
    reason[(x - disparity < -0.5) | (x - disparity > width - 0.5) | (x < low)] = StereoReason.OUT_OF_VIEW
    starts = (reason != StereoReason.OCCLUDED).cumsum(axis=1) == 0
    reason[starts] = StereoReason.OUT_OF_VIEW
    return apart, reason


@pytest.mark.parametrize("low", [0, 3, -5])
def test_loops_say_what_arrays_say(rng, low):
    winner = rng.integers(0, 12, SHAPE).astype(np.uint16)
    lowest = rng.integers(0, 300, SHAPE).astype(np.uint16)
    second = (lowest + rng.integers(0, 60, SHAPE)).astype(np.uint16)
    beside = (lowest[..., None] + rng.integers(0, 40, (*SHAPE, 2))).astype(np.uint16)
    beside[rng.random(beside.shape) < 0.1] = NOBODY
    other = rng.integers(0, 12, SHAPE).astype(np.uint16)
    other[rng.random(SHAPE) < 0.1] = NOBODY
    out = tuple(np.empty(SHAPE, np.float32) for _ in range(3))
    consistency.bottom_of_v(winner, lowest, beside, other, low, 0, 25, out)
    consistency.bottom_of_v(winner, lowest, beside, other, low, 25, SHAPE[0], out)
    for mine, theirs in zip(out, bottom_by_arrays(winner, lowest, beside, other, low)):
        np.testing.assert_array_equal(mine, theirs.astype(np.float32))
    disparity, _, others = out
    blank = (rng.random(SHAPE) < 0.2, rng.random(SHAPE) < 0.2)
    for limits in ((0.0, 1.25), (0.1, 4.0)):
        found = (np.empty(SHAPE, np.float32), np.empty(SHAPE, np.uint8))
        consistency.check_rows((disparity, lowest, second), others, blank, low, limits, 0, SHAPE[0], found)
        apart, reason = check_by_arrays(disparity, lowest, second, others, blank, low, limits)
        np.testing.assert_array_equal(found[0], apart)
        np.testing.assert_array_equal(found[1], reason)
        assert len(np.unique(reason)) == 5  # every reason that is given here occurs


def test_reasons_have_the_same_numbers():
    for name in ("OK", "OCCLUDED", "OUT_OF_VIEW", "AMBIGUOUS", "TEXTURELESS"):
        assert getattr(consistency, name) == StereoReason[name]
