"""Subpixel refinement and consistency checks of disparities.

Comparisons use the same types as NumPy arrays: tests compare these loops with equivalent array code.
"""

import numpy as np

from epipole._jit import kernel
from epipole.disparity_search._path_kernels import NOBODY

OK, OCCLUDED, OUT_OF_VIEW, AMBIGUOUS, TEXTURELESS = 0, 1, 2, 3, 5


@kernel
def bottom_of_v(winner, lowest, beside, other, first, start, stop, out):
    """Subpixel disparities of rows start..stop with the steepness of their sums, and integer ones of the other image.

    The minimum of a V with two equal slopes through the lowest sum and its neighbors, within 1/2 of the integer disparity: sums of
    census costs grow linearly from their minimum, and a parabola would be biased toward integers. At the ends of the range the
    disparity stays an integer. out = (disparity, steepness, disparity of the other image, which may be empty).
    """
    disparity, steepness, others = out
    half, one, low = np.float32(0.5), np.float32(1.0), np.float32(first)
    for y in range(start, stop):
        for x in range(winner.shape[1]):
            whole, least = np.float32(winner[y, x]), np.float32(lowest[y, x])
            down = np.float32(beside[y, x, 0]) - least
            up = np.float32(beside[y, x, 1]) - least
            if beside[y, x, 0] == NOBODY or beside[y, x, 1] == NOBODY:
                disparity[y, x], steepness[y, x] = whole + low, min(down, up)
            else:
                steep = max(down, up)
                disparity[y, x] = whole + half * (down - up) / max(steep, one) + low
                steepness[y, x] = steep
            if other.size:
                there = other[y, x]
                others[y, x] = np.float32(np.nan) if there == NOBODY else np.float32(there) + low


@kernel
def check_rows(mine, theirs, blank, first, limits, start, stop, out):
    """Difference from the other image's disparity, and reason, of each pixel of rows start..stop.

    mine = (disparity, lowest sum, second), theirs = the other image's disparities, blank = masks of textureless pixels (of this image,
    of the other), limits = (margin, largest difference), out = (difference, reason). The difference is infinite if the other image
    has no disparity.
    """
    disparity, lowest, second = mine
    here_blank, there_blank = blank
    least_margin, most_apart = limits
    apart, reason = out
    width = disparity.shape[1]
    for y in range(start, stop):
        starts = True
        for x in range(width):
            position = x - np.float64(disparity[y, x])
            column = int(np.rint(position))
            difference = np.float32(np.inf)
            if 0 <= column < width and np.isfinite(theirs[y, column]):
                difference = abs(theirs[y, column] - disparity[y, x])
            apart[y, x] = difference
            margin = np.float64(second[y, x]) - np.float64(lowest[y, x])
            if position < -0.5 or position > width - 0.5 or x < first:
                found = OUT_OF_VIEW
            elif not difference <= most_apart:
                found = OCCLUDED
            elif margin <= least_margin * lowest[y, x]:
                found = AMBIGUOUS
            elif here_blank[y, x] or there_blank[y, min(max(column, 0), width - 1)]:
                found = TEXTURELESS
            else:
                found = OK
            # Surfaces at the start of a row, before its first known pixel, extend beyond the border of the other image.
            starts = starts and found == OCCLUDED
            reason[y, x] = OUT_OF_VIEW if starts else found
