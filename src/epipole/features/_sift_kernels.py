"""Orientation and descriptor of scale-space extrema (Lowe, IJCV 2004, sections 5 and 6)."""

import numpy as np

from epipole._jit import kernel

ORIENTATION_BINS = 36
_ORIENTATION_SIGMA = 1.5
"""Standard deviation of the window in which gradients vote for the orientation, in feature scales."""
_SECOND_PEAK = 0.8
CELLS, ANGLES = 4, 8
"""A descriptor has CELLS x CELLS histograms of ANGLES directions."""
_CELL_SCALES = 3.0
"""Side of a cell, in feature scales."""
SAMPLES = 4
"""Samples along the side of a cell; the window reaches half a cell beyond the outermost cells."""
MOST_ORIENTATIONS = 4
_LARGEST = 0.2
"""Entries of the unit-length descriptor are clipped here to limit the influence of single strong gradients."""
_UNIT = 512.0

# atan(t) / t as a polynomial of t^2 on [0, 1], least squares at Chebyshev nodes; error below 2e-5 rad.
_A0, _A1, _A2, _A3, _A4 = (
    np.float32(c) for c in (0.99986634, -0.33030484, 0.18015933, -0.08515627, 0.02084504)
)
_PI = np.float32(np.pi)


@kernel(inline=True)
def _direction(y, x):
    """atan2 without branches, so that loops over it vectorise."""
    ax, ay = abs(x), abs(y)
    larger = ax if ax > ay else ay
    smaller = ay if ax > ay else ax
    t = smaller / (larger + np.float32(1e-20))
    q = t * t
    angle = t * (_A0 + q * (_A1 + q * (_A2 + q * (_A3 + q * _A4))))
    angle = angle if ax >= ay else np.float32(0.5) * _PI - angle
    angle = angle if x >= np.float32(0.0) else _PI - angle
    return angle if y >= np.float32(0.0) else -angle


@kernel(allocates=True)
def describe_all(levels, extrema, sigma, pixel, sizes, columns, descriptors):
    """Orient and describe the extrema of one octave.

    Args:
        levels: the inner levels of the octave, a tuple of images.
        extrema: (n, 4) of x, y, scale, level (from 1), as found.
        sigma: (n,) scales, in pixels of the octave.
        pixel: side of a pixel of the octave, in pixels of the image.
        sizes: (k,) sizes of the windows that a descriptor averages, relative to the feature's.
        columns: (MOST_ORIENTATIONS n, 4), output: x, y, diameter in pixels of the image; radians, x toward y.
        descriptors: (MOST_ORIENTATIONS n, 128) uint8, output.

    Returns:
        number of rows written.
    """
    tables, angles, count = window_tables(), np.empty(MOST_ORIENTATIONS), 0
    histogram = np.empty((CELLS + 2, CELLS + 2, ANGLES), np.float32)
    for i in range(len(extrema)):
        level, x, y = levels[int(extrema[i, 3]) - 1], float(extrema[i, 0]), float(extrema[i, 1])
        for k in range(find_orientations(level, x, y, sigma[i], angles)):
            columns[count, 0], columns[count, 1] = x * pixel, y * pixel
            columns[count, 2], columns[count, 3] = 2.0 * sigma[i] * pixel, angles[k]
            histogram[:] = np.float32(0.0)
            for size in sizes:
                # Levels are a third of an octave apart.
                nearest = int(np.rint(extrema[i, 3] + len(levels) * np.log2(size))) - 1
                inside = levels[min(max(nearest, 0), len(levels) - 1)]
                add_histogram(inside, x, y, size * sigma[i], angles[k], tables, histogram)
            _root(histogram, descriptors[count])
            count += 1
    return count


@kernel(allocates=True)
def describe_upright(level, pixels, sigma, descriptors):
    """Describe unrotated windows of one size.

    Args:
        level: the blurred image.
        pixels: (n, 2) window centers.
        sigma: scale in pixels, the same for all.
        descriptors: (n, 128) uint8, output.
    """
    tables = window_tables()
    histogram = np.empty((CELLS + 2, CELLS + 2, ANGLES), np.float32)
    for i in range(len(pixels)):
        histogram[:] = np.float32(0.0)
        add_histogram(level, pixels[i, 0], pixels[i, 1], sigma, 0.0, tables, histogram)
        _root(histogram, descriptors[i])


@kernel(allocates=True)
def find_orientations(level, x, y, sigma, angles):
    """Peaks of the histogram of gradient directions around (x, y); up to len(angles), strongest first.

    Args:
        level: the blurred image closest in scale, (height, width).
        x: column in pixels of the level.
        y: row.
        sigma: scale in pixels of the level.
        angles: filled with directions in radians, x toward y.

    Returns:
        number of peaks that reach 0.8 of the highest.
    """
    height, width = level.shape
    window = _ORIENTATION_SIGMA * sigma
    radius = int(np.rint(3.0 * window))
    cx, cy = int(np.rint(x)), int(np.rint(y))
    left, right = max(cx - radius, 1), min(cx + radius, width - 2)
    n = right - left + 1
    across = np.empty(n, np.float32)
    for k in range(n):
        across[k] = np.exp(-0.5 * ((left + k - cx) / window) ** 2)
    weight, bins = np.empty(n, np.float32), np.empty(n, np.int32)
    histogram = np.zeros(ORIENTATION_BINS, np.float32)
    to_bin, half = np.float32(ORIENTATION_BINS / (2.0 * np.pi)), np.float32(ORIENTATION_BINS + 0.5)
    for row in range(max(cy - radius, 1), min(cy + radius, height - 2) + 1):
        down = np.float32(np.exp(-0.5 * ((row - cy) / window) ** 2))
        above, here, below = level[row - 1, left:], level[row, left - 1 :], level[row + 1, left:]
        for k in range(n):
            gx, gy = here[k + 2] - here[k], below[k] - above[k]
            weight[k] = down * across[k] * np.sqrt(gx * gx + gy * gy)
            bins[k] = np.int32(_direction(gy, gx) * to_bin + half)
        for k in range(n):
            histogram[bins[k] % ORIENTATION_BINS] += weight[k]
    return _peaks(_smoothed(histogram), angles)


@kernel(allocates=True)
def _smoothed(histogram):
    n = len(histogram)
    out = np.empty(n, np.float32)
    for i in range(n):
        near = histogram[i - 1] + histogram[(i + 1) % n]
        far = histogram[i - 2] + histogram[(i + 2) % n]
        out[i] = (6.0 * histogram[i] + 4.0 * near + far) / 16.0
    return out


@kernel(allocates=True)
def _peaks(histogram, angles):
    """Local maxima, refined by a parabola through three bins, strongest first."""
    n, count = len(histogram), 0
    heights = np.empty(len(angles), np.float32)
    least = _SECOND_PEAK * histogram.max()
    for i in range(n):
        before, here, after = histogram[i - 1], histogram[i], histogram[(i + 1) % n]
        if here <= before or here <= after or here < least:
            continue
        offset = 0.5 * (before - after) / (before - 2.0 * here + after)
        position = min(count, len(angles))
        while position > 0 and heights[position - 1] < here:
            if position < len(angles):
                heights[position], angles[position] = heights[position - 1], angles[position - 1]
            position -= 1
        if position < len(angles):
            heights[position], angles[position] = here, (i + offset) * (2.0 * np.pi / n)
        count = min(count + 1, len(angles))
    return count


@kernel(allocates=True)
def window_tables():
    """For the samples along one side of the window: Gaussian weight, lower cell, weights of it and the next."""
    n = SAMPLES * (CELLS + 1)
    gauss, cell = np.empty(n, np.float32), np.empty(n, np.int64)
    lower, upper = np.empty(n, np.float32), np.empty(n, np.float32)
    for i in range(n):
        u = (i + 0.5) / SAMPLES - 0.5 * (CELLS + 1)
        gauss[i] = np.exp(-0.5 * (u / (0.5 * CELLS)) ** 2)
        position = u + 0.5 * CELLS - 0.5
        first = int(np.floor(position))
        cell[i] = first + 1
        upper[i] = position - first
        lower[i] = 1.0 - upper[i]
    return gauss, cell, lower, upper


@kernel(allocates=True)
def add_histogram(level, x, y, sigma, angle, tables, pooled):
    """Add the gradients of the rotated window around (x, y), at unit length, to a histogram.

    Several windows of one feature add up to a descriptor that tolerates larger changes of scale and viewpoint (domain-size
    pooling: Dong and Soatto, CVPR 2015).

    The window is sampled on its own rotated grid, SAMPLES per cell, so that the cell and the weight of every sample are
    the same for all features; only the gradient direction has to be computed.

    Args:
        level: the blurred image closest in scale.
        x: column in pixels of the level.
        y: row.
        sigma: scale in pixels of the level.
        angle: orientation in radians, x toward y.
        tables: output of `window_tables`.
        pooled: (CELLS + 2, CELLS + 2, ANGLES), added to; its outer cells are not part of the descriptor.
    """
    gauss, cell, lower, upper = tables
    n = len(gauss)
    patch = np.empty((n + 2, n + 2), np.float32)
    _sample(level, x, y, _CELL_SCALES * sigma / SAMPLES, angle, patch)
    histogram = np.zeros((CELLS + 2, CELLS + 2, ANGLES), np.float32)
    band = np.empty((CELLS + 2, ANGLES), np.float32)
    magnitude, first, fraction = np.empty(n, np.float32), np.empty(n, np.int32), np.empty(n, np.float32)
    to_bin, whole = np.float32(ANGLES / (2.0 * np.pi)), np.float32(ANGLES)
    for i in range(n):
        above, here, below = patch[i, 1:], patch[i + 1], patch[i + 2, 1:]
        for j in range(n):
            gx, gy = here[j + 2] - here[j], below[j] - above[j]
            magnitude[j] = gauss[j] * np.sqrt(gx * gx + gy * gy)
            position = whole - _direction(gy, gx) * to_bin
            first[j] = np.int32(position)
            fraction[j] = position - np.float32(first[j])
        band[:] = np.float32(0.0)
        for j in range(n):
            c, o = cell[j], first[j] & (ANGLES - 1)
            p = (o + 1) & (ANGLES - 1)
            left, right = magnitude[j] * lower[j], magnitude[j] * upper[j]
            band[c, o] += left * (np.float32(1.0) - fraction[j])
            band[c, p] += left * fraction[j]
            band[c + 1, o] += right * (np.float32(1.0) - fraction[j])
            band[c + 1, p] += right * fraction[j]
        a, b = gauss[i] * lower[i], gauss[i] * upper[i]
        for c in range(CELLS + 2):
            for o in range(ANGLES):
                histogram[cell[i], c, o] += a * band[c, o]
                histogram[cell[i] + 1, c, o] += b * band[c, o]
    total = np.float32(0.0)
    for r in range(1, CELLS + 1):
        for c in range(1, CELLS + 1):
            for o in range(ANGLES):
                total += histogram[r, c, o] ** 2
    scale = np.float32(1.0) / np.sqrt(total + np.float32(1e-20))
    for r in range(1, CELLS + 1):
        for c in range(1, CELLS + 1):
            for o in range(ANGLES):
                pooled[r, c, o] += scale * histogram[r, c, o]


@kernel(allocates=True)
def _sample(level, x, y, step, angle, patch):
    """Bilinear samples on a grid rotated by `angle` and centered at (x, y); the border is replicated."""
    height, width = level.shape
    ux, uy = np.float32(step * np.cos(angle)), np.float32(step * np.sin(angle))
    n = len(patch)
    middle = np.float32(0.5 * (n - 1))
    most_x, most_y = np.float32(width - 1.001), np.float32(height - 1.001)
    # Clamp the integers too: in a very wide level a float32 rounds to the last column.
    last_x, last_y = np.int32(width - 2), np.int32(height - 2)
    zero = np.float32(0.0)
    flat = level.ravel()
    for i in range(n):
        v = np.float32(i) - middle
        start_x = np.float32(x) - v * uy - middle * ux
        start_y = np.float32(y) + v * ux - middle * uy
        for j in range(n):
            px, py = start_x + np.float32(j) * ux, start_y + np.float32(j) * uy
            px = px if px < most_x else most_x
            px = px if px > zero else zero
            py = py if py < most_y else most_y
            py = py if py > zero else zero
            ix, iy = min(np.int32(px), last_x), min(np.int32(py), last_y)
            fx, fy = px - np.float32(ix), py - np.float32(iy)
            k = iy * np.int32(width) + ix
            top = flat[k] + fx * (flat[k + 1] - flat[k])
            bottom = flat[k + width] + fx * (flat[k + width + 1] - flat[k + width])
            patch[i, j] = top + fy * (bottom - top)


@kernel
def _root(histogram, descriptor):
    """Root-SIFT as bytes of length 512: normalize, clip at 0.2, take the square root (Arandjelovic and Zisserman, CVPR 2012)."""
    total = np.float32(0.0)
    for r in range(1, CELLS + 1):
        for c in range(1, CELLS + 1):
            for o in range(ANGLES):
                total += histogram[r, c, o] ** 2
    largest, total = np.float32(_LARGEST) * np.sqrt(total), np.float32(0.0)
    for r in range(1, CELLS + 1):
        for c in range(1, CELLS + 1):
            for o in range(ANGLES):
                value = histogram[r, c, o]
                histogram[r, c, o] = value if value < largest else largest
                total += histogram[r, c, o]
    scale = np.float32(1.0) / (total + np.float32(1e-20))
    k = 0
    for r in range(1, CELLS + 1):
        for c in range(1, CELLS + 1):
            for o in range(ANGLES):
                descriptor[k] = np.uint8(min(255.0, np.rint(_UNIT * np.sqrt(histogram[r, c, o] * scale))))
                k += 1
