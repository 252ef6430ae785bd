"""Best and second best of every row, and best of every column, of a block of a similarity matrix.

Similarities are integers below 2^24 in float32, so they are exact and can be compared for equality. The running top
two are kept per lane: max and min vectorize, unlike a search for an index.
"""

import numpy as np

from epipole._jit import kernel

LANES = 32


@kernel(allocates=True)
def top_two(block, rows, best, second, column_best):
    """Row-wise best and second best of block[:rows], and column_best = max over the rows seen so far."""
    cols = block.shape[1]
    whole = cols - cols % LANES
    first_lane, second_lane = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    for i in range(rows):
        row = block[i]
        for c in range(LANES):
            first_lane[c], second_lane[c] = -1.0, -1.0
        for j in range(0, whole, LANES):
            for c in range(LANES):
                v = row[j + c]
                a = first_lane[c]
                low = v if v < a else a
                first_lane[c] = v if v > a else a
                b = second_lane[c]
                second_lane[c] = low if low > b else b
        a, b = np.float32(-1.0), np.float32(-1.0)
        for c in range(LANES):
            if first_lane[c] > a:
                b = max(a, second_lane[c])
                a = first_lane[c]
            else:
                b = max(b, first_lane[c])
        for j in range(whole, cols):
            if row[j] > a:
                b, a = a, row[j]
            elif row[j] > b:
                b = row[j]
        best[i], second[i] = a, b
        for j in range(cols):
            column_best[j] = row[j] if row[j] > column_best[j] else column_best[j]


@kernel
def find_best_column(block, rows, best, wanted, out):
    """The first column of each wanted row that contains the row's best."""
    for i in range(rows):
        if wanted[i]:
            row = block[i]
            for j in range(block.shape[1]):
                if row[j] == best[i]:
                    out[i] = j
                    break


@kernel
def hamming_top_two(a, b, best_column, best, second, column_best):
    """Nearest and second nearest row of b for each row of a, in bits; column_best: nearest distance from b."""
    for i in range(len(a)):
        best[i], second[i], best_column[i] = 1 << 30, 1 << 30, -1
        for j in range(len(b)):
            distance = 0
            for c in range(a.shape[1]):
                x = a[i, c] ^ b[j, c]
                x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
                x = (x & np.uint64(0x3333333333333333)) + (
                    (x >> np.uint64(2)) & np.uint64(0x3333333333333333)
                )
                x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
                distance += np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))
            if distance < best[i]:
                second[i], best[i], best_column[i] = best[i], distance, j
            elif distance < second[i]:
                second[i] = distance
            column_best[j] = min(column_best[j], distance)


@kernel
def _dot(a, b):
    total = np.int32(0)
    for c in range(a.shape[0]):
        total += np.int32(a[c]) * np.int32(b[c])
    return total


@kernel
def guided_top_two(
    pixels1,
    descriptors1,
    along_x,
    along_y,
    f,
    band,
    strip,
    cell,
    best_column,
    best,
    second,
    column_best,
):
    """Nearest and second nearest feature of image 2 within `band` pixels of each feature's epipolar line F x.

    along_x and along_y hold image 2's features cell by cell: (order, pixels, descriptors, first), where first[s, c] is the
    index of the first feature of cell c (of length `cell`) in strip s (of width `strip`); strips are consecutive along x,
    or y. A line is traversed strip by strip along the axis to which it is closer.
    """
    for i in range(len(pixels1)):
        best[i], second[i], best_column[i] = -1, -1, -1
        x, y = pixels1[i, 0], pixels1[i, 1]
        a = f[0, 0] * x + f[0, 1] * y + f[0, 2]
        b = f[1, 0] * x + f[1, 1] * y + f[1, 2]
        c = f[2, 0] * x + f[2, 1] * y + f[2, 2]
        size = np.sqrt(a * a + b * b)
        if not size > 0.0:
            continue
        a, b, c = a / size, b / size, c / size
        order, pixels, descriptors, first = along_x if abs(b) >= abs(a) else along_y
        along, across = (a, b) if abs(b) >= abs(a) else (b, a)
        cells = first.shape[1] - 1
        # Where the line enters strip s, in cells: start + s * step.
        start, step = -c / (across * cell), -along * strip / (across * cell)
        least, most = (
            min(step, 0.0) - band / (abs(across) * cell),
            max(step, 0.0) + band / (abs(across) * cell),
        )
        for s in range(len(first)):
            low, high = start + s * step + least, start + s * step + most
            if not (high >= 0.0 and low < cells):
                continue
            first_item, end = first[s, int(max(low, 0.0))], first[s, int(min(high, cells - 1.0)) + 1]
            for n in range(first_item, end):
                if abs(a * pixels[n, 0] + b * pixels[n, 1] + c) > band:
                    continue
                j = order[n]
                v = _dot(descriptors1[i], descriptors[n])
                if v > best[i]:
                    second[i], best[i], best_column[i] = best[i], v, j
                elif v > second[i]:
                    second[i] = v
                if v > column_best[j]:
                    column_best[j] = v


@kernel
def nearby_top_two(
    wanted, wanted_descriptors, cells_of, strip, cell, radius, best_column, best, second, column_best
):
    """Most and second most similar feature within `radius` of each wanted pixel; column_best: of each feature.

    cells_of holds the features cell by cell (order, pixels, descriptors, first), in strips along x, as `guided_top_two`.
    """
    order, pixels, descriptors, first = cells_of
    strips, cells = first.shape[0], first.shape[1] - 1
    for i in range(len(wanted)):
        best[i], second[i], best_column[i] = -1, -1, -1
        x, y = wanted[i, 0], wanted[i, 1]
        if not (x + radius >= 0.0 and y + radius >= 0.0):
            continue
        low = min(int(max(y - radius, 0.0) / cell), cells)
        high = min(int((y + radius) / cell), cells - 1)
        for s in range(
            min(int(max(x - radius, 0.0) / strip), strips), min(int((x + radius) / strip), strips - 1) + 1
        ):
            if low > high:
                break
            for n in range(first[s, low], first[s, high + 1]):
                if (pixels[n, 0] - x) ** 2 + (pixels[n, 1] - y) ** 2 > radius * radius:
                    continue
                j = order[n]
                v = _dot(wanted_descriptors[i], descriptors[n])
                if v > best[i]:
                    second[i], best[i], best_column[i] = best[i], v, j
                elif v > second[i]:
                    second[i] = v
                if v > column_best[j]:
                    column_best[j] = v
