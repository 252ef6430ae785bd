"""Semi-global matching of a strip of rows (Hirschmueller, PAMI 2008).

For every pixel and disparity, costs are summed along eight or four straight paths that end there, in two sweeps: downward with the
paths from the left and from above, upward with those from the right and from below. Costs are recomputed in each sweep, which is
cheaper than reading them back; between the sweeps only the sums of the first one are stored.

Index k is the disparity `first + k`. The state of the paths is (2 rows, MOST paths, width + 2, EDGE + depth) bytes, flat: the previous
and the present row alternate, with a column at either end in which every path starts.
"""

import numpy as np

from epipole._jit import kernel
from epipole.disparity_search._simd_kernels import LANES, count_bits, extend_paths, keep_lower, least_two

MOST = 4  # paths of one sweep
EDGE = LANES  # bytes between the disparities of neighbors: 255, which no path passes
NEVER = 255  # the cost of a disparity outside the image
NOBODY = 65535


@kernel
def cost_row(images, y, size, search, out):
    """Costs (width, depth) of row y: Hamming distance of the census, plus half the brightness difference up to `most`.

    images = (left, right, left brightness, right brightness, most). left (h, width, planes) and right (h, planes, padded width) are
    the flat census; rows of right and of its brightness (h, padded width) are mirrored, so that disparities ascend.
    size = (height, width, planes, padding), search = (first, count, depth). most = 0: census only.
    """
    left, right, bright, other_bright, most = images
    _, width, planes, padding = size
    first, count, depth = search
    stride = width + 2 * padding
    for x in range(width):
        at = x * depth
        at_right = y * planes * stride + padding + width - 1 - x + first
        count_bits(left, (y * width + x) * planes, right, at_right, stride, planes, out, at, depth // LANES)
        if most > 0:
            here, there = np.int16(bright[y * width + x]), y * stride + padding + width - 1 - x + first
            for k in range(depth):
                apart = abs(np.int16(other_bright[there + k]) - here) >> 1
                out[at + k] += min(apart, most)
        # x - first - k is inside the other image for lowest <= k < highest.
        lowest, highest = max(x - first - width + 1, 0), min(x - first + 1, count)
        for k in range(min(lowest, depth)):
            out[at + k] = NEVER
        for k in range(max(highest, 0), depth):
            out[at + k] = NEVER


@kernel
def start_paths(paths, least, width, depth):
    """Initialize the state of the paths with zero costs."""
    for n in range(2 * MOST * (width + 2)):
        at = EDGE + n * (EDGE + depth)
        for k in range(depth):
            paths[at + k] = 0
    for n in range(2):
        for k in range(MOST):
            for c in range(width + 2):
                least[n, k, c] = 0


@kernel
def sweep_row(costs, gray, y, y_before, step, size, depth, penalties, state, sums, at_sums):
    """Advance the paths from the side (step = 1: from the left) and from the previous row through row y; write their sums.

    penalties = (number of paths of both sweeps, P1, P2 by brightness difference), state = (paths, minimum of each).
    """
    num_paths, small, jumps = penalties
    paths, least = state
    width = size[1]
    stride = EDGE + depth
    block = (width + 2) * stride
    now, then = y & 1, 1 - (y & 1)
    base, base_then = now * MOST * block + EDGE, then * MOST * block + EDGE
    for n in range(width):
        x = n if step > 0 else width - 1 - n
        c = x + 1
        back, value = c - step, gray[y, x]
        at, before = base + c * stride, base_then + block + c * stride
        beside = jumps[abs(value - gray[y, min(max(x - step, 0), width - 1)])]
        over = jumps[abs(value - gray[y_before, x])]
        from_side = base + back * stride
        if num_paths == 4:
            low = extend_paths(
                paths,
                (from_side, before),
                (least[now, 0, back], least[then, 1, c]),
                (beside, over),
                small,
                costs,
                x * depth,
                (at, at + block),
                sums,
                at_sums + x * depth,
                depth // LANES,
            )
            least[now, 0, c], least[now, 1, c] = low
        else:
            aslant = jumps[abs(value - gray[y_before, max(x - 1, 0)])]
            across = jumps[abs(value - gray[y_before, min(x + 1, width - 1)])]
            lows = extend_paths(
                paths,
                (from_side, before, before + block - stride, before + 2 * block + stride),
                (least[now, 0, back], least[then, 1, c], least[then, 2, c - 1], least[then, 3, c + 1]),
                (beside, over, aslant, across),
                small,
                costs,
                x * depth,
                (at, at + block, at + 2 * block, at + 3 * block),
                sums,
                at_sums + x * depth,
                depth // LANES,
            )
            least[now, 0, c], least[now, 1, c], least[now, 2, c], least[now, 3, c] = lows


@kernel
def choose_row(sums, at_row, more, y, width, search, out, best, winners):
    """Add the second sweep's sums of row y to those of the first, and find the lowest ones of both images.

    out = (winner, lowest, second, beside, spread, winner of the other image), where spread is the difference between the winners of
    the two sweeps. best and winners are scratch, one element for each pixel of the other image from right to left; these and the
    other's winner are empty if not requested.
    """
    winner, lowest, second, beside, spread, other = out
    first, _, depth = search
    shift = max(-first, 0)
    for p in range(len(best)):
        best[p], winners[p] = NOBODY, NOBODY
    for x in range(width):
        at = at_row + x * depth
        k, low, next_low, above, below = least_two(sums, at, more, x * depth, depth // LANES)
        winner[y, x], lowest[y, x], second[y, x], spread[y, x] = k, low, next_low, abs(above - below)
        beside[y, x, 0] = sums[at + k - 1] if k > 0 else NOBODY
        beside[y, x, 1] = sums[at + k + 1] if k + 1 < depth else NOBODY
        if len(best):
            keep_lower(sums, at, best, winners, width - 1 - x + first + shift, depth // LANES)
    if len(best):
        for x in range(width):
            other[y, x] = winners[width - 1 - x + shift]


@kernel(allocates=True)
def match_strip(images, gray, size, search, penalties, start, stop, margin, sums, out):
    """Disparities of rows start..stop; paths start up to `margin` rows beyond them. sums: buffer for (stop - start) rows."""
    height, width = size[0], size[1]
    first, _, depth = search
    positions = width + depth + abs(first) if out[5].size else 0
    room = width * depth
    paths = np.full(2 * MOST * (width + 2) * (EDGE + depth) + EDGE, 255, np.uint8)
    state = (paths, np.empty((2, MOST, width + 2), np.int64))
    costs, row = np.empty(room, np.uint8), np.empty(room, np.uint16)
    best, winners = np.empty(positions, np.uint16), np.empty(positions, np.uint16)
    start_paths(paths, state[1], width, depth)
    for y in range(max(start - margin, 0), stop):
        cost_row(images, y, size, search, costs)
        above = max(y - 1, 0)
        if y < start:
            sweep_row(costs, gray, y, above, 1, size, depth, penalties, state, row, 0)
        else:
            sweep_row(costs, gray, y, above, 1, size, depth, penalties, state, sums, (y - start) * room)
    start_paths(paths, state[1], width, depth)
    for y in range(min(stop + margin, height) - 1, start - 1, -1):
        cost_row(images, y, size, search, costs)
        sweep_row(costs, gray, y, min(y + 1, height - 1), -1, size, depth, penalties, state, row, 0)
        if y < stop:
            at = (y - start) * room
            choose_row(sums, at, row, y, width, search, out, best, winners)
