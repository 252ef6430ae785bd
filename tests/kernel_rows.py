"""The instructions on rows that kernels say outright (`epipole._simd_kernels` and others), in NumPy.

The names are those of the intrinsics they stand for. Fused products are rounded twice here and once there.
"""

from typing import Any

import numpy as np


def _row(array: Any, lanes: Any) -> Any:
    return array[: len(lanes)].astype(np.float64)


def add_rows(target, a, x, b, y, c, z, lanes):
    target[: len(lanes)] = _row(target, lanes) + a * _row(x, lanes) + b * _row(y, lanes) + c * _row(z, lanes)


def add_two_rows(target, a, x, b, y, lanes):
    target[: len(lanes)] = _row(target, lanes) + a * _row(x, lanes) + b * _row(y, lanes)


def set_rows(target, a, x, b, y, c, z, lanes):
    target[: len(lanes)] = a * _row(x, lanes) + b * _row(y, lanes) + c * _row(z, lanes)


def set_two_rows(target, a, x, b, y, lanes):
    target[: len(lanes)] = a * _row(x, lanes) + b * _row(y, lanes)


def subtract_product(block, x, y, height, lanes):
    block[:height, : len(lanes)] -= x[:, :height].T.astype(np.float64) @ y[:, : len(lanes)].astype(np.float64)


def scale_row(target, a, x, lanes):
    target[: len(lanes)] = a * _row(x, lanes)


def add_product(target, x, y, lanes):
    target[: len(lanes)] = _row(target, lanes) + _row(x, lanes) * _row(y, lanes)


_BLOCK = 32


def count_bits(left, at_left, right, at_right, width, planes, out, at_out, blocks):
    count = _BLOCK * blocks
    total = np.zeros(count, np.uint8)
    for plane in range(planes):
        start = at_right + plane * width
        total += np.bitwise_count(left[at_left + plane] ^ right[start : start + count])
    out[at_out : at_out + count] = total


def extend_paths(paths, at_before, least, jump, step, costs, at_cost, at_now, sums, at_sums, blocks):
    count = _BLOCK * blocks
    own, total, found = costs[at_cost : at_cost + count].astype(int), np.zeros(count, int), []
    for before, low, far, now in zip(at_before, least, jump, at_now):
        same, below, above = (paths[before + k : before + k + count].astype(int) for k in (0, -1, 1))
        best = np.minimum(np.minimum(same, np.minimum(below, above) + step), low + far)
        path = np.minimum(best - low + own, 255)
        paths[now : now + count] = path
        total += path
        found.append(int(path.min()))
    sums[at_sums : at_sums + count] = total
    return tuple(found)


def least_two(sums, at_sums, more, at_more, blocks):
    count = _BLOCK * blocks
    row, added = sums[at_sums : at_sums + count], more[at_more : at_more + count]
    first, other = int(row.argmin()), int(added.argmin())
    row += added
    position = int(row.argmin())
    far = np.abs(np.arange(count) - position) > 1
    return position, int(row[position]), int(row[far].min()), first, other


def keep_lower(sums, at_sums, best, winners, at_best, blocks):
    count = _BLOCK * blocks
    row = sums[at_sums : at_sums + count]
    lower = np.flatnonzero(row < best[at_best : at_best + count])
    best[at_best + lower], winners[at_best + lower] = row[lower], lower
