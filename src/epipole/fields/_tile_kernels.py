"""Which ellipses touch which tiles of a picture, each tile's in the order of their depth."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.fields._projection_kernels import HALF_HEIGHT, NARROWING, REACH, RIGHTMOST, SLOPE, X, Y

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
def widest(slope, reach, narrowing, down, top, bottom):
    """How far left and right an ellipse reaches between two heights, all seen from its middle, `down` that of its rightmost point.

    Its sides are curved outwards: each is furthest at that height between the two that is nearest to its own end.
    """
    at_right, at_left = min(max(down, top), bottom), min(max(-down, top), bottom)
    left = -slope * at_left - math.sqrt(max(reach - narrowing * at_left * at_left, np.float32(0.0)))
    right = -slope * at_right + math.sqrt(max(reach - narrowing * at_right * at_right, np.float32(0.0)))
    return left, right


@kernel(fuse=True)
def _tiles_in_row(ellipse, row, width, height):
    """First and last tile of a row of tiles that the ellipse touches: where its sides are furthest within these pixels."""
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
