"""What is known of each pixel once its sums have been looked at: where between the whole disparities it lies, and whether it holds.

Values are compared as arrays of NumPy would be: tests hold the same statements in that form beside these loops.
"""

import numpy as np

from epipole._jit import kernel
from epipole.disparity_search._path_kernels import NOBODY

OK, OCCLUDED, OUT_OF_VIEW, AMBIGUOUS, TEXTURELESS = 0, 1, 2, 3, 5


@kernel
def bottom_of_v(winner, lowest, beside, other, first, start, stop, out):
    """Disparities of rows start..stop, with the steepness of their sums, and the other image's, from whole ones.

    Where a V of two equal slopes through the lowest sum and those beside it has its bottom, -1/2 ... 1/2 from the whole disparity: sums
    of census costs grow linearly from their minimum; a parabola would draw it to the whole numbers. At the ends of the range
    there is one slope, and the disparity stays whole. out = (disparity, steepness, other's disparity); the other's may be empty.
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
    """Difference from the other image's disparity and reason of each pixel of rows start..stop.

    mine = (disparity, lowest sum, second), theirs = the other image's disparities, blank = (of this image, of the other): where
    nothing changes along the row. limits = (margin, largest difference). out = (difference, reason); where the other image
    has nothing the difference is infinite.
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
            # Before the first known pixel of a row surfaces begin that reach beyond the other image's border.
            starts = starts and found == OCCLUDED
            reason[y, x] = OUT_OF_VIEW if starts else found
