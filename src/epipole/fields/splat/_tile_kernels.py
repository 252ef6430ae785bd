"""Assign ellipses to the tiles they touch, sorted by depth."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.fields.splat._projection_kernels import (
    ELLIPSE,
    HALF_HEIGHT,
    NARROWING,
    REACH,
    RIGHTMOST,
    SLOPE,
    X,
    Y,
)
from epipole.fields.splat._simd_kernels import fetch

TILE = 16
DIGIT, LAST_DIGIT = 11, 2047
"""Bits of a digit of the radix sort, and its largest value."""
SOON = 8
"""Ellipses to prefetch ahead, because their addresses are random and memory latency exceeds the work per ellipse."""


@kernel
def sort_by_depth(bits, first, second, counts):
    """Write rows of nonzero depth, nearest first (stable), to the start of `second` (n,); returns their number.

    A radix sort of 11 bits at a time: depths are positive, so their bits (n,) sort like the depths. first (n,) and
    zeroed counts (3, 2048) are scratch. It takes a quarter of the time of sorting depth and row as one number.
    """
    for row in range(len(bits)):
        if bits[row] != 0:
            for digit in range(3):
                counts[digit, (bits[row] >> DIGIT * digit) & LAST_DIGIT] += 1
    total = 0
    for digit in range(3):
        total = 0
        for value in range(LAST_DIGIT + 1):
            here = counts[digit, value]
            counts[digit, value] = total
            total += here
    for row in range(len(bits)):
        if bits[row] != 0:
            _put_by_digit(row, bits, 0, counts, second)
    for at in range(total):
        _put_by_digit(second[at], bits, 1, counts, first)
    for at in range(total):
        _put_by_digit(first[at], bits, 2, counts, second)
    return total


@kernel(fuse=True)
def _put_by_digit(row, bits, digit, counts, out):
    value = (bits[row] >> DIGIT * digit) & LAST_DIGIT
    out[counts[digit, value]] = row
    counts[digit, value] += 1


@kernel(fuse=True)
def _rows_of_tiles(ellipse, height):
    """First and last row of tiles in which the ellipse has a pixel; last < first if there is none."""
    first = max(math.ceil(ellipse[Y] - ellipse[HALF_HEIGHT]), 0)
    last = min(math.floor(ellipse[Y] + ellipse[HALF_HEIGHT]), height - 1)
    if last < first:
        return 0, -1
    return int(first) // TILE, int(last) // TILE


@kernel(fuse=True)
def widest(slope, reach, narrowing, down, top, bottom):
    """Leftmost and rightmost x of an ellipse between two heights, relative to its center; `down`: y of the rightmost.

    The sides are convex, so each reaches farthest at the height between the two that is nearest to its extreme point.
    """
    at_right, at_left = min(max(down, top), bottom), min(max(-down, top), bottom)
    left = -slope * at_left - math.sqrt(max(reach - narrowing * at_left * at_left, np.float32(0.0)))
    right = -slope * at_right + math.sqrt(max(reach - narrowing * at_right * at_right, np.float32(0.0)))
    return left, right


@kernel(fuse=True)
def _tiles_in_row(ellipse, row, width, height):
    """First and last tile that the ellipse touches in a row of tiles; last < first if there is none."""
    top = max(TILE * row, math.ceil(ellipse[Y] - ellipse[HALF_HEIGHT])) - ellipse[Y]
    bottom = (
        min(TILE * row + TILE - 1, height - 1, math.floor(ellipse[Y] + ellipse[HALF_HEIGHT])) - ellipse[Y]
    )
    left, right = widest(ellipse[SLOPE], ellipse[REACH], ellipse[NARROWING], ellipse[RIGHTMOST], top, bottom)
    first = max(math.ceil(ellipse[X] + left), 0)
    last = min(math.floor(ellipse[X] + right), width - 1)
    if last < first:
        return 0, -1
    return int(first) // TILE, int(last) // TILE


@kernel
def count_tiles(seen, order, start, stop, size, num_across, ellipses, counts, of_ellipse):
    """Copy the rows of `seen`, in the given order, to start..stop of `ellipses`.

    Adds the number of ellipses per tile to `counts` (tiles,); writes the number of tiles per ellipse to `of_ellipse`.
    """
    flat = seen.reshape(-1)
    for e in range(start, stop):
        fetch(flat, order[min(e + SOON, stop - 1)] * ELLIPSE)
        for k in range(ELLIPSE):
            ellipses[e, k] = seen[order[e], k]
        total = 0
        first, last = _rows_of_tiles(ellipses[e], size[1])
        for row in range(first, last + 1):
            left, right = _tiles_in_row(ellipses[e], row, size[0], size[1])
            for column in range(left, right + 1):
                counts[row * num_across + column] += 1
            total += max(right - left + 1, 0)
        of_ellipse[e] = total


@kernel
def fill_tiles(ellipses, start, stop, size, num_across, position, pair, pairs_of_tile):
    """Add ellipses start..stop to the lists of their tiles.

    `position` (tiles,) is the next free row of each tile, and is advanced; `pair` (ellipses,) is the first pair of each
    ellipse; `pairs_of_tile` (pairs, 2) gets ellipse and pair.
    """
    for e in range(start, stop):
        number = pair[e]
        first, last = _rows_of_tiles(ellipses[e], size[1])
        for row in range(first, last + 1):
            left, right = _tiles_in_row(ellipses[e], row, size[0], size[1])
            for column in range(left, right + 1):
                tile = row * num_across + column
                pairs_of_tile[position[tile], 0] = e
                pairs_of_tile[position[tile], 1] = number
                position[tile] += 1
                number += 1
