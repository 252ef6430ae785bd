"""Blend the ellipses of each tile front to back, and compute derivatives in the same order.

With alpha_i, color c_i and transmittance T_i = prod_{j<i} (1 - alpha_j) a pixel is sum_i alpha_i T_i c_i, and with
v_i = c_i . dL/dC
    dL/dalpha_i = T_i v_i - (sum_{j>i} alpha_j T_j v_j) / (1 - alpha_i).
The backward pass needs no reverse order, because the sum over j > i is the total minus what was accumulated, one number
per pixel. Each ellipse-tile pair writes its own row of sums, so that no two threads add to the same number.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.fields.splat._projection_kernels import (
    BLUE,
    DEPTH,
    ELLIPSE,
    GREEN,
    HALF_HEIGHT,
    NARROWING,
    PEAK,
    REACH,
    RED,
    RIGHTMOST,
    SLOPE,
    XX,
    XY,
    YY,
    X,
    Y,
)
from epipole.fields.splat._simd_kernels import (
    ACROSS,
    LANES,
    LARGEST_ALPHA,
    LEAST_ALPHA,
    PLANE,
    SIDE,
    SUMS,
    blend_block,
    blend_block_backward,
    fetch,
    lowest_bit,
    sum_of_lanes,
    touched_blocks,
)
from epipole.fields.splat._tile_kernels import SOON, TILE

OVER = np.float32(1e-4)
"""Transmittance below which a pixel counts as opaque."""
CHECK_EVERY = 16
"""Ellipses between two checks whether a tile is opaque."""


@kernel(fuse=True)
def _is_over(state):
    seen = 0
    for k in range(PLANE):
        seen += state[k] > OVER
    return seen == 0


@kernel(fuse=True)
def _fetch_row(flat, row, width):
    """Prefetch a row of an array, which may span two cache lines."""
    fetch(flat, np.int64(row) * width)
    fetch(flat, np.int64(row) * width + width - 1)


@kernel(fuse=True)
def _blocks_of(e, x, y, last_row):
    """Bit mask of the blocks that an ellipse at (x, y) of the tile touches."""
    return touched_blocks(x, y, e[SLOPE], e[REACH], e[NARROWING], e[RIGHTMOST], e[HALF_HEIGHT], last_row)


@kernel
def blend_tile(ellipses, pairs_of_tile, first, last, left, top, rows, state):
    """Blend pairs first..last of a tile with corner (left, top); state (5, 256) has transmittance, color and depth.

    Returns the pair at which the tile became opaque, and the number of pixels evaluated.
    """
    count, last_row, flat = 0, np.float32(rows - 1), ellipses.reshape(-1)
    for at in range(first, last):
        if (at - first) % CHECK_EVERY == CHECK_EVERY - 1 and _is_over(state):
            return at, count
        _fetch_row(flat, pairs_of_tile[min(at + SOON, last - 1), 0], ELLIPSE)
        e = ellipses[pairs_of_tile[at, 0]]
        x, y = e[X] - left, e[Y] - top
        shape = e[XX], e[XY], e[YY], e[PEAK]
        color = e[RED], e[GREEN], e[BLUE], e[DEPTH]
        blocks = _blocks_of(e, x, y, last_row)
        while blocks:
            block = lowest_bit(blocks)
            blocks &= blocks - 1
            blend_block(state, block * LANES, x, y, *shape, *color)
            count += LANES
    return last, count


@kernel(fuse=True)
def position_in_tile(row, column):
    """Index of a pixel in a tile's state, which is ordered block by block."""
    block = row // SIDE * ACROSS + column // SIDE
    return block * LANES + row % SIDE * SIDE + column % SIDE


@kernel
def blend_tiles(tiles, start, end, color, depth, coverage, evaluated, state):
    """Blend tiles start..end into images (h, w, 3), (h, w) and (h, w); state (5 * 256,) is scratch."""
    height, width = coverage.shape
    for tile in range(start, end):
        top, left = TILE * (tile // tiles.num_across), TILE * (tile % tiles.num_across)
        rows, columns = min(TILE, height - top), min(TILE, width - left)
        for k in range(5 * PLANE):
            state[k] = np.float32(0.0)
        for row in range(rows):
            for column in range(columns):
                state[position_in_tile(row, column)] = np.float32(1.0)
        tiles.stop[tile], evaluated[tile] = blend_tile(
            tiles.ellipses,
            tiles.pairs_of_tile,
            tiles.start[tile],
            tiles.start[tile + 1],
            np.float32(left),
            np.float32(top),
            rows,
            state,
        )
        for row in range(rows):
            for column in range(columns):
                at, i, j = position_in_tile(row, column), top + row, left + column
                coverage[i, j] = np.float32(1.0) - state[at]
                for channel in range(3):
                    color[i, j, channel] = state[(1 + channel) * PLANE + at]
                depth[i, j] = state[4 * PLANE + at]


@kernel
def blend_tile_backward(ellipses, pairs_of_tile, first, last, left, top, rows, state, sums, by_pair):
    """Write the derivatives of pairs first..last of a tile to their rows of `by_pair` (pairs, SUMS).

    `state` (7, 256), flat: see `blend_block_backward`; sums (SUMS * 16,) is scratch.
    """
    last_row, flat, flat_out = np.float32(rows - 1), ellipses.reshape(-1), by_pair.reshape(-1)
    for at in range(first, last):
        soon = min(at + SOON, last - 1)
        _fetch_row(flat, pairs_of_tile[soon, 0], ELLIPSE)
        _fetch_row(flat_out, pairs_of_tile[soon, 1], SUMS)
        e = ellipses[pairs_of_tile[at, 0]]
        x, y = e[X] - left, e[Y] - top
        shape = e[XX], e[XY], e[YY], e[PEAK]
        color = e[RED], e[GREEN], e[BLUE], e[DEPTH]
        for k in range(SUMS * LANES):
            sums[k] = np.float32(0.0)
        blocks = _blocks_of(e, x, y, last_row)
        while blocks:
            block = lowest_bit(blocks)
            blocks &= blocks - 1
            blend_block_backward(state, block * LANES, sums, x, y, *shape, *color)
        out = by_pair[pairs_of_tile[at, 1]]
        for k in range(SUMS):
            out[k] = sum_of_lanes(sums, k * LANES)


@kernel
def blend_tiles_backward(tiles, start, end, wanted, by_pair, state, sums):
    """Derivatives of tiles start..end; `wanted` has the image and dL/d(image); state (7 * 256,), sums are scratch."""
    height, width = wanted.coverage.shape
    for tile in range(start, end):
        top, left = TILE * (tile // tiles.num_across), TILE * (tile % tiles.num_across)
        rows = min(TILE, height - top)
        for k in range(7 * PLANE):
            state[k] = np.float32(0.0)
        for row in range(rows):
            for column in range(min(TILE, width - left)):
                at, i, j = position_in_tile(row, column), top + row, left + column
                state[at] = np.float32(1.0)
                rest = (
                    wanted.depth[i, j] * wanted.by_depth[i, j]
                    + wanted.coverage[i, j] * wanted.by_coverage[i, j]
                )
                for channel in range(3):
                    rest += wanted.color[i, j, channel] * wanted.by_color[i, j, channel]
                    state[(2 + channel) * PLANE + at] = wanted.by_color[i, j, channel]
                state[PLANE + at] = rest
                state[5 * PLANE + at], state[6 * PLANE + at] = wanted.by_depth[i, j], wanted.by_coverage[i, j]
        first, last = tiles.start[tile], tiles.stop[tile]
        blend_tile_backward(
            tiles.ellipses,
            tiles.pairs_of_tile,
            first,
            last,
            np.float32(left),
            np.float32(top),
            rows,
            state,
            sums,
            by_pair,
        )
        for at in range(last, tiles.start[tile + 1]):
            for k in range(SUMS):
                by_pair[tiles.pairs_of_tile[at, 1], k] = np.float32(0.0)


@kernel
def put_over(color, coverage, background, start, stop, out):
    """Put rows start..stop of an image (h, w, 3) over a background color."""
    for row in range(start, stop):
        for column in range(coverage.shape[1]):
            behind = np.float32(1.0) - coverage[row, column]
            for k in range(3):
                out[row, column, k] = color[row, column, k] + behind * background[k]


@kernel
def count_useful(tiles, start, end, width, height):
    """Number of pixel-ellipse pairs in tiles start..end that change their pixel: neither transparent nor occluded."""
    count = 0
    for tile in range(start, end):
        top, left = TILE * (tile // tiles.num_across), TILE * (tile % tiles.num_across)
        for row in range(top, min(top + TILE, height)):
            for column in range(left, min(left + TILE, width)):
                through = np.float32(1.0)
                for at in range(tiles.start[tile], tiles.start[tile + 1]):
                    e = tiles.ellipses[tiles.pairs_of_tile[at, 0]]
                    dx, dy = np.float32(column) - e[X], np.float32(row) - e[Y]
                    eighth = e[XX] * dx * dx + e[XY] * dx * dy + e[YY] * dy * dy + e[PEAK]
                    alpha = np.float32(math.exp(np.float32(8.0) * eighth))
                    if alpha >= LEAST_ALPHA:
                        count += 1
                        through *= np.float32(1.0) - min(alpha, LARGEST_ALPHA)
                        if through <= OVER:
                            break
    return count
