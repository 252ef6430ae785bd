"""Block matching of a strip of rows: the disparity with the lowest sum of costs over a square window.

Column sums are updated from row to row, and window sums from pixel to pixel: two additions and two subtractions per pixel and
disparity, independent of the window size.
"""

import numpy as np

from epipole._jit import kernel
from epipole.disparity_search._path_kernels import choose_row, cost_row


@kernel
def add_row(columns, row):
    """Column sums += a row of costs."""
    for i in range(len(row)):
        columns[i] += row[i]


@kernel
def take_row(columns, row):
    """Column sums -= a row of costs."""
    for i in range(len(row)):
        columns[i] -= row[i]


@kernel
def sum_across(columns, half, width, depth, sums):
    """Sums (width, depth) over the columns x - half ... x + half of each pixel x, clipped to the image."""
    running = sums[:depth]
    running[:] = 0
    for c in range(min(half, width - 1) + 1):
        for k in range(depth):
            running[k] += columns[c * depth + k]
    for x in range(1, width):
        enters, leaves = x + half, x - half - 1
        at, before = x * depth, (x - 1) * depth
        if enters < width and leaves >= 0:
            for k in range(depth):
                sums[at + k] = sums[before + k] + columns[enters * depth + k] - columns[leaves * depth + k]
        elif enters < width:
            for k in range(depth):
                sums[at + k] = sums[before + k] + columns[enters * depth + k]
        elif leaves >= 0:
            for k in range(depth):
                sums[at + k] = sums[before + k] - columns[leaves * depth + k]
        else:
            for k in range(depth):
                sums[at + k] = sums[before + k]


@kernel(allocates=True)
def match_blocks(images, size, search, half, start, stop, out):
    """Disparities of rows start..stop. Windows are clipped at the image borders; out as in `choose_row`."""
    height, width = size[0], size[1]
    first, _, depth = search
    positions = width + depth + abs(first) if out[5].size else 0
    room, rows = width * depth, 2 * half + 1
    ring = np.zeros((rows, room), np.uint8)
    columns, sums, none = np.zeros(room, np.uint16), np.empty(room, np.uint16), np.zeros(room, np.uint16)
    best, winners = np.empty(positions, np.uint16), np.empty(positions, np.uint16)
    spread = out[4]
    for y in range(start - half, stop + half):
        position = ring[(y + rows) % rows]
        take_row(columns, position)  # the row that leaves the window
        if 0 <= y < height:
            cost_row(images, y, size, search, position)
        else:
            position[:] = 0
        add_row(columns, position)
        middle = y - half
        if start <= middle:
            sum_across(columns, half, width, depth, sums)
            choose_row(sums, 0, none, middle, width, search, out, best, winners)
            spread[middle, :] = 0  # there are no two sweeps to compare
