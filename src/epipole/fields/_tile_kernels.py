"""Which ellipses touch which tiles of a picture, each tile's in the order of their depth."""

import math

from epipole._jit import kernel
from epipole.fields._projection_kernels import HALF_HEIGHT, HALF_WIDTH, NARROWING, REACH, SLOPE, X, Y

TILE = 16


@kernel(fuse=True)
def _rows_of_tiles(ellipse, height):
    """First and last row of tiles that the ellipse has a pixel in; the last is smaller where there is none."""
    first = max(math.ceil(ellipse[Y] - ellipse[HALF_HEIGHT]), 0)
    last = min(math.floor(ellipse[Y] + ellipse[HALF_HEIGHT]), height - 1)
    if last < first:
        return 0, -1
    return int(first) // TILE, int(last) // TILE


@kernel(fuse=True)
def _tiles_in_row(ellipse, row, width, height):
    """First and last tile of a row of tiles that the ellipse touches: where its sides are furthest within these pixels."""
    top = max(TILE * row, math.ceil(ellipse[Y] - ellipse[HALF_HEIGHT])) - ellipse[Y]
    bottom = (
        min(TILE * row + TILE - 1, height - 1, math.floor(ellipse[Y] + ellipse[HALF_HEIGHT])) - ellipse[Y]
    )
    at_top = math.sqrt(max(ellipse[REACH] - ellipse[NARROWING] * top * top, 0.0))
    at_bottom = math.sqrt(max(ellipse[REACH] - ellipse[NARROWING] * bottom * bottom, 0.0))
    left = min(-ellipse[SLOPE] * top - at_top, -ellipse[SLOPE] * bottom - at_bottom)
    right = max(-ellipse[SLOPE] * top + at_top, -ellipse[SLOPE] * bottom + at_bottom)
    # The ellipse's rightmost point is that far down, its leftmost that far up.
    down = -ellipse[SLOPE] * ellipse[HALF_HEIGHT] * ellipse[HALF_HEIGHT] / ellipse[HALF_WIDTH]
    if top < down < bottom:
        right = ellipse[HALF_WIDTH]
    if top < -down < bottom:
        left = -ellipse[HALF_WIDTH]
    first = max(math.ceil(ellipse[X] + left), 0)
    last = min(math.floor(ellipse[X] + right), width - 1)
    if last < first:
        return 0, -1
    return int(first) // TILE, int(last) // TILE


@kernel
def count_tiles(ellipses, start, stop, size, num_across, counts, of_ellipse):
    """Add to `counts` (tiles,) the ellipses start..stop that touch each; `of_ellipse` gets the tiles of each."""
    for e in range(start, stop):
        total = 0
        first, last = _rows_of_tiles(ellipses[e], size[1])
        for row in range(first, last + 1):
            left, right = _tiles_in_row(ellipses[e], row, size[0], size[1])
            for column in range(left, right + 1):
                counts[row * num_across + column] += 1
            total += max(right - left + 1, 0)
        of_ellipse[e] = total


@kernel
def fill_tiles(ellipses, start, stop, size, num_across, place, pair, pairs_of_tile):
    """Write the ellipses start..stop into the lists of their tiles.

    `place` (tiles,) is where the next one of each tile goes, and moves on; `pair` (ellipses,) the number of each one's first pair;
    `pairs_of_tile` (pairs, 2) gets the ellipse and the pair.
    """
    for e in range(start, stop):
        number = pair[e]
        first, last = _rows_of_tiles(ellipses[e], size[1])
        for row in range(first, last + 1):
            left, right = _tiles_in_row(ellipses[e], row, size[0], size[1])
            for column in range(left, right + 1):
                tile = row * num_across + column
                pairs_of_tile[place[tile], 0] = e
                pairs_of_tile[place[tile], 1] = number
                place[tile] += 1
                number += 1
