"""Tiles of a picture: their ellipses are blended front to back, and derivatives go the same way once more.

With alpha_i, colour c_i and transmittance T_i = prod_{j<i} (1 - alpha_j) a pixel is sum_i alpha_i T_i c_i. Its derivatives, with v_i = c_i . dL/dC,
    dL/dalpha_i = T_i v_i - (sum_{j>i} alpha_j T_j v_j) / (1 - alpha_i),
need no second order: what comes behind is the whole less what has come, one number a pixel. Each pair of an ellipse and a tile writes
its own row of sums, so that nothing is added by two threads.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.fields._projection_kernels import (
    BLUE,
    DEPTH,
    GREEN,
    HALF_HEIGHT,
    NARROWING,
    OPACITY,
    REACH,
    RED,
    SLOPE,
    A,
    B,
    C,
    X,
    Y,
)
from epipole.fields._simd_kernels import LANES, PLANE, SUMS, blend_row, unblend_row
from epipole.fields._tile_kernels import TILE

OVER = np.float32(1e-4)
"""Transmittance below which what comes behind is not seen."""
LOOK_EVERY = 16
"""Ellipses after which a tile looks whether it is over."""
HALF = TILE // 2


@kernel(fuse=True)
def _is_over(state, rows):
    seen = 0
    for k in range(rows * TILE):
        seen += state[k] > OVER
    return seen == 0


@kernel
def blend_tile(ellipses, pairs_of_tile, first, last, left, top, rows, state):
    """Blend the pairs first..last of a tile with corner (left, top); state (5, 256), flat, gets transmittance, colour and depth.

    Returns the pair at which it was over, and the pixels that were evaluated.
    """
    one, zero = np.float32(1.0), np.float32(0.0)
    for k in range(PLANE):
        state[k] = one
    for k in range(PLANE, 5 * PLANE):
        state[k] = zero
    count = 0
    for at in range(first, last):
        if (at - first) % LOOK_EVERY == LOOK_EVERY - 1 and _is_over(state, rows):
            return at, count
        e = ellipses[pairs_of_tile[at, 0]]
        x, y = e[X] - left, e[Y] - top
        half_a, half_c = np.float32(0.5) * e[A], np.float32(-0.5) * e[C]
        low = max(0, math.ceil(y - e[HALF_HEIGHT]))
        high = min(rows - 1, math.floor(y + e[HALF_HEIGHT]))
        for row in range(low, high + 1):
            dy = np.float32(row) - y
            width_sq = e[REACH] - e[NARROWING] * dy * dy
            if width_sq <= zero:
                continue
            width, middle = np.float32(math.sqrt(width_sq)), x - e[SLOPE] * dy
            begin, end = middle - width, middle + width
            q, b_dy = half_c * dy * dy, e[B] * dy
            if begin <= HALF - 1 and end >= zero:
                blend_row(
                    *(state, row * TILE, -x, q, half_a, b_dy),
                    *(e[OPACITY], e[RED], e[GREEN], e[BLUE], e[DEPTH]),
                )
                count += LANES
            if end >= HALF and begin <= TILE - 1:
                blend_row(
                    *(state, row * TILE + HALF, np.float32(HALF) - x, q, half_a, b_dy),
                    *(e[OPACITY], e[RED], e[GREEN], e[BLUE], e[DEPTH]),
                )
                count += LANES
    return last, count


@kernel
def blend_tiles(tiles, begin, end, colour, depth, coverage, evaluated, state):
    """Blend the tiles begin..end into pictures (h, w, 3), (h, w) and (h, w); state (5 * 256,) is scratch."""
    height, width = coverage.shape
    for tile in range(begin, end):
        top, left = TILE * (tile // tiles.num_across), TILE * (tile % tiles.num_across)
        rows = min(TILE, height - top)
        tiles.stop[tile], evaluated[tile] = blend_tile(
            *(tiles.ellipses, tiles.pairs_of_tile, tiles.start[tile], tiles.start[tile + 1]),
            *(np.float32(left), np.float32(top), rows, state),
        )
        for row in range(rows):
            for column in range(min(TILE, width - left)):
                at, i, j = row * TILE + column, top + row, left + column
                coverage[i, j] = np.float32(1.0) - state[at]
                for channel in range(3):
                    colour[i, j, channel] = state[(1 + channel) * PLANE + at]
                depth[i, j] = state[4 * PLANE + at]


@kernel
def unblend_tile(ellipses, pairs_of_tile, first, last, left, top, rows, state, sums, by_pair):
    """Derivatives of the pairs first..last of a tile, by the rows of their numbers in `by_pair` (pairs, SUMS).

    `state` (7, 256), flat: see `unblend_row`; sums (SUMS * 8,) is scratch.
    """
    zero = np.float32(0.0)
    for at in range(first, last):
        e = ellipses[pairs_of_tile[at, 0]]
        x, y = e[X] - left, e[Y] - top
        half_a, half_c = np.float32(0.5) * e[A], np.float32(-0.5) * e[C]
        low = max(0, math.ceil(y - e[HALF_HEIGHT]))
        high = min(rows - 1, math.floor(y + e[HALF_HEIGHT]))
        for k in range(SUMS * LANES):
            sums[k] = zero
        for row in range(low, high + 1):
            dy = np.float32(row) - y
            width_sq = e[REACH] - e[NARROWING] * dy * dy
            if width_sq <= zero:
                continue
            width, middle = np.float32(math.sqrt(width_sq)), x - e[SLOPE] * dy
            begin, end = middle - width, middle + width
            q, b_dy = half_c * dy * dy, e[B] * dy
            if begin <= HALF - 1 and end >= zero:
                unblend_row(
                    *(state, row * TILE, sums, -x, dy, q, half_a, b_dy),
                    *(e[OPACITY], e[RED], e[GREEN], e[BLUE], e[DEPTH]),
                )
            if end >= HALF and begin <= TILE - 1:
                unblend_row(
                    *(state, row * TILE + HALF, sums, np.float32(HALF) - x, dy, q, half_a, b_dy),
                    *(e[OPACITY], e[RED], e[GREEN], e[BLUE], e[DEPTH]),
                )
        out = by_pair[pairs_of_tile[at, 1]]
        for k in range(SUMS):
            total = zero
            for lane in range(LANES):
                total += sums[k * LANES + lane]
            out[k] = total


@kernel
def unblend_tiles(tiles, begin, end, wanted, by_pair, state, sums):
    """Derivatives of the tiles begin..end; `wanted` holds the picture and dL/d of it, state (7 * 256,) and sums are scratch."""
    height, width = wanted.coverage.shape
    for tile in range(begin, end):
        top, left = TILE * (tile // tiles.num_across), TILE * (tile % tiles.num_across)
        rows = min(TILE, height - top)
        for k in range(7 * PLANE):
            state[k] = np.float32(0.0)
        for row in range(rows):
            for column in range(min(TILE, width - left)):
                at, i, j = row * TILE + column, top + row, left + column
                state[at] = np.float32(1.0)
                rest = (
                    wanted.depth[i, j] * wanted.by_depth[i, j]
                    + wanted.coverage[i, j] * wanted.by_coverage[i, j]
                )
                for channel in range(3):
                    rest += wanted.colour[i, j, channel] * wanted.by_colour[i, j, channel]
                    state[(2 + channel) * PLANE + at] = wanted.by_colour[i, j, channel]
                state[PLANE + at] = rest
                state[5 * PLANE + at], state[6 * PLANE + at] = wanted.by_depth[i, j], wanted.by_coverage[i, j]
        first, last = tiles.start[tile], tiles.stop[tile]
        unblend_tile(
            *(tiles.ellipses, tiles.pairs_of_tile, first, last),
            *(np.float32(left), np.float32(top), rows, state, sums, by_pair),
        )
        for at in range(last, tiles.start[tile + 1]):
            for k in range(SUMS):
                by_pair[tiles.pairs_of_tile[at, 1], k] = np.float32(0.0)
