"""Gaussian scale space and extrema of its differences (Lowe, IJCV 2004, sections 3 and 4).

Full rows are processed at a time, so every inner loop runs over adjacent columns and vectorizes. Differences of
Gaussians are computed row by row as needed and never stored.
"""

import numpy as np

from epipole._jit import kernel

SCALES = 3
"""Scales per octave; an octave has SCALES + 3 levels, and extrema in levels 1 to SCALES of the differences."""
BORDER = 5
"""Width of the border in which no extrema are searched, in pixels of each level."""
_REFINEMENTS = 5


@kernel(allocates=True)
def upsample(gray, out):
    """Double the size: pixel (2 x, 2 y) of `out` is pixel (x, y) of `gray` / 255, the others are interpolated."""
    height, width = gray.shape
    unit, half = np.float32(1.0 / 255.0), np.float32(0.5)
    row, below = np.empty(width + 1, np.float32), np.empty(width + 1, np.float32)
    for y in range(height):
        next_y = min(y + 1, height - 1)
        for x in range(width):
            row[x], below[x] = np.float32(gray[y, x]) * unit, np.float32(gray[next_y, x]) * unit
        row[width], below[width] = row[width - 1], below[width - 1]
        even, odd = out[2 * y], out[2 * y + 1]
        for x in range(width):
            a, b = row[x], half * (row[x] + row[x + 1])
            c, d = below[x], half * (below[x] + below[x + 1])
            even[2 * x], even[2 * x + 1] = a, b
            odd[2 * x], odd[2 * x + 1] = half * (a + c), half * (b + d)


@kernel
def halve(level, out):
    """Keep every second pixel of every second row."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x] = level[2 * y, 2 * x]


@kernel(allocates=True)
def blur(level, weights, out):
    """Gaussian blur, columns then rows; the image is mirrored at the border.

    Args:
        level: (height, width), float32.
        weights: of the offsets 0, 1, ..., float32; their number must be odd, as offsets are processed in pairs (the
            last weight may be zero).
        out: (height, width).
    """
    height, width = level.shape
    radius = len(weights) - 1
    line = np.empty(width + 2 * radius, np.float32)
    inner = line[radius : radius + width]
    for y in range(height):
        center = level[y]
        for x in range(width):
            inner[x] = weights[0] * center[x]
        for k in range(1, radius, 2):
            a, b = level[_mirrored(y - k, height)], level[_mirrored(y + k, height)]
            c, d = level[_mirrored(y - k - 1, height)], level[_mirrored(y + k + 1, height)]
            w, v = weights[k], weights[k + 1]
            for x in range(width):
                inner[x] += w * (a[x] + b[x]) + v * (c[x] + d[x])
        for k in range(1, radius + 1):
            line[radius - k] = inner[_mirrored(-k, width)]
            line[radius + width - 1 + k] = inner[_mirrored(width - 1 + k, width)]
        target = out[y]
        for x in range(width):
            target[x] = weights[0] * inner[x]
        for k in range(1, radius, 2):
            a, b = line[radius - k :], line[radius + k :]
            c, d = line[radius - k - 1 :], line[radius + k + 1 :]
            w, v = weights[k], weights[k + 1]
            for x in range(width):
                target[x] += w * (a[x] + b[x]) + v * (c[x] + d[x])


@kernel(inline=True)
def _mirrored(i, n):
    period = max(2 * n - 2, 1)
    i = abs(i) % period
    return i if i < n else period - i


@kernel(allocates=True)
def find_extrema(levels, threshold, least_contrast, most_edge, found):
    """Extrema of the differences of Gaussians among 26 neighbors, refined to subpixel position.

    Args:
        levels: one octave, a tuple of SCALES + 3 images (height, width).
        threshold: pixels with smaller |difference| are skipped.
        least_contrast: smallest |difference| at the refined position.
        most_edge: largest ratio of principal curvatures.
        found: (capacity, 4) for x, y, scale (level 1 + fraction ...) and level, float32.

    Returns:
        number of extrema; larger than the capacity if some did not fit.
    """
    height, width = levels[0].shape
    differences = np.empty((3, SCALES + 2, width), np.float32)
    high, low = np.empty((3, SCALES + 2, width), np.float32), np.empty((3, SCALES + 2, width), np.float32)
    highest, lowest = np.empty((SCALES + 2, width), np.float32), np.empty((SCALES + 2, width), np.float32)
    is_extreme = np.zeros(width + (-width) % 8, np.uint8)
    eight = is_extreme.view(np.uint64)
    count = np.int64(0)  # a literal would compile the callee twice
    for y in range(BORDER - 1, height - BORDER + 1):
        slot = y % 3
        for s in range(SCALES + 2):
            _difference_row(levels[s][y], levels[s + 1][y], differences[slot, s], high[slot, s], low[slot, s])
        if y < BORDER + 1:
            continue
        for s in range(SCALES + 2):
            _of_three(
                high[0, s], high[1, s], high[2, s], highest[s], low[0, s], low[1, s], low[2, s], lowest[s]
            )
        for s in range(1, SCALES + 1):
            _mark_extremes(
                differences[(y - 1) % 3, s],
                highest[s - 1],
                highest[s],
                highest[s + 1],
                lowest[s - 1],
                lowest[s],
                lowest[s + 1],
                threshold,
                is_extreme,
            )
            for block in range(len(eight)):
                if eight[block] == 0:
                    continue
                for x in range(max(8 * block, BORDER), min(8 * block + 8, width - BORDER)):
                    if is_extreme[x]:
                        count += _refine(levels, s, y - 1, x, least_contrast, most_edge, found, count)
    return count


@kernel
def _difference_row(lower, upper, out, high, low):
    """The difference upper - lower, and the maximum and minimum of every three neighbors along the row."""
    width = len(lower)
    for x in range(width):
        out[x] = upper[x] - lower[x]
    for x in range(1, width - 1):
        a, b, c = out[x - 1], out[x], out[x + 1]
        top = a if a > b else b
        high[x] = top if top > c else c
        bottom = a if a < b else b
        low[x] = bottom if bottom < c else c


@kernel
def _of_three(high0, high1, high2, highest, low0, low1, low2, lowest):
    for x in range(1, len(highest) - 1):
        top = high0[x] if high0[x] > high1[x] else high1[x]
        highest[x] = top if top > high2[x] else high2[x]
        bottom = low0[x] if low0[x] < low1[x] else low1[x]
        lowest[x] = bottom if bottom < low2[x] else low2[x]


@kernel
def _mark_extremes(here, high0, high1, high2, low0, low1, low2, threshold, is_extreme):
    """Mark pixels that are the maximum or minimum of their 27 and exceed the threshold; ignore the border."""
    for x in range(len(here)):
        high = high0[x] if high0[x] > high1[x] else high1[x]
        high = high2[x] if high2[x] > high else high
        high = threshold if threshold > high else high
        low = low0[x] if low0[x] < low1[x] else low1[x]
        low = low2[x] if low2[x] < low else low
        low = -threshold if -threshold < low else low
        is_extreme[x] = (here[x] >= high) | (here[x] <= low)


@kernel
def _refine(levels, s, y, x, least_contrast, most_edge, found, count):
    """Newton steps on the quadratic through the neighbors (Brown and Lowe, BMVC 2002); 1 if accepted, else 0."""
    height, width = levels[0].shape
    for _ in range(_REFINEMENTS):
        here = _difference(levels, s, y, x)
        gx = 0.5 * (_difference(levels, s, y, x + 1) - _difference(levels, s, y, x - 1))
        gy = 0.5 * (_difference(levels, s, y + 1, x) - _difference(levels, s, y - 1, x))
        gs = 0.5 * (_difference(levels, s + 1, y, x) - _difference(levels, s - 1, y, x))
        hxx = _difference(levels, s, y, x + 1) + _difference(levels, s, y, x - 1) - 2.0 * here
        hyy = _difference(levels, s, y + 1, x) + _difference(levels, s, y - 1, x) - 2.0 * here
        hss = _difference(levels, s + 1, y, x) + _difference(levels, s - 1, y, x) - 2.0 * here
        hxy = 0.25 * (
            _difference(levels, s, y + 1, x + 1)
            - _difference(levels, s, y + 1, x - 1)
            - _difference(levels, s, y - 1, x + 1)
            + _difference(levels, s, y - 1, x - 1)
        )
        hxs = 0.25 * (
            _difference(levels, s + 1, y, x + 1)
            - _difference(levels, s + 1, y, x - 1)
            - _difference(levels, s - 1, y, x + 1)
            + _difference(levels, s - 1, y, x - 1)
        )
        hys = 0.25 * (
            _difference(levels, s + 1, y + 1, x)
            - _difference(levels, s + 1, y - 1, x)
            - _difference(levels, s - 1, y + 1, x)
            + _difference(levels, s - 1, y - 1, x)
        )
        # Cramer's rule for H d = -g.
        mxx, mxy, mxs = hyy * hss - hys * hys, hxs * hys - hxy * hss, hxy * hys - hyy * hxs
        myy, mys, mss = hxx * hss - hxs * hxs, hxy * hxs - hxx * hys, hxx * hyy - hxy * hxy
        determinant = hxx * mxx + hxy * mxy + hxs * mxs
        if determinant == 0.0:
            return 0
        dx = -(mxx * gx + mxy * gy + mxs * gs) / determinant
        dy = -(mxy * gx + myy * gy + mys * gs) / determinant
        ds = -(mxs * gx + mys * gy + mss * gs) / determinant
        if abs(dx) < 0.5 and abs(dy) < 0.5 and abs(ds) < 0.5:
            value = here + 0.5 * (gx * dx + gy * dy + gs * ds)
            trace = hxx + hyy
            if abs(value) < least_contrast or mss <= 0.0:
                return 0
            if trace * trace * most_edge >= (most_edge + 1.0) ** 2 * mss:
                return 0
            if count < len(found):
                found[count, 0], found[count, 1] = x + dx, y + dy
                found[count, 2], found[count, 3] = s + ds, s
            return 1
        if not (abs(dx) < width and abs(dy) < height and abs(ds) < SCALES):
            return 0
        x, y, s = x + int(np.rint(dx)), y + int(np.rint(dy)), s + int(np.rint(ds))
        if not (1 <= s <= SCALES and BORDER <= x < width - BORDER and BORDER <= y < height - BORDER):
            return 0
    return 0


@kernel(inline=True)
def _difference(levels, s, y, x):
    return np.float64(levels[s + 1][y, x]) - np.float64(levels[s][y, x])
