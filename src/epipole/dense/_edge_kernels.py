"""Choice of the depth of a pixel by how well a small window around it matches, at depth edges and in holes."""

import numpy as np

from epipole._jit import kernel

TAPS = 5
"""Side of the window in pixels."""
COLOR_SIGMA, SPACE_SIGMA = 12.0, 3.0
"""Standard deviations of the window's weights, in gray levels and pixels (Yoon and Kweon, PAMI 2006)."""
SAME = 0.003
"""Relative difference of inverse depth up to which two hypotheses are one."""
GOOD = 0.4
"""Largest cost of a source that shows the window."""
LEAST_VARIANCE = 4.0
"""Smallest variance of a window, in squared gray levels: a correlation of less would be noise."""
HIDDEN = 2.0
"""Cost of a source that does not show the window."""


@kernel
def slope_rows(q, reach, tolerance, start, stop, out):
    """Slopes (dq/du, dq/dv) of the inverse depth in rows start..stop, by least squares over the window's pixels near the center's value.

    q (h, w): NaN where unknown. Pixels differ by at most the fraction `tolerance`. out (h, w, 2), zero where unknown.
    """
    height, width = q.shape
    for v in range(start, stop):
        for u in range(width):
            out[v, u, 0], out[v, u, 1] = 0.0, 0.0
            center = q[v, u]
            if not center > 0.0:
                continue
            n = su = sv = sq = suu = suv = svv = suq = svq = 0.0
            for dv in range(-reach, reach + 1, 2):
                for du in range(-reach, reach + 1, 2):
                    y, x = v + dv, u + du
                    if y < 0 or x < 0 or y >= height or x >= width:
                        continue
                    change = q[y, x] - center
                    if not abs(change) <= tolerance * center:
                        continue
                    n += 1.0
                    su, sv, sq = su + du, sv + dv, sq + change
                    suu, suv, svv = suu + du * du, suv + du * dv, svv + dv * dv
                    suq, svq = suq + du * change, svq + dv * change
            if n < 6.0:
                continue
            suu, suv, svv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
            suq, svq = suq - su * sq / n, svq - sv * sq / n
            det = suu * svv - suv * suv
            if det > 1.0:
                out[v, u, 0] = (svv * suq - suv * svq) / det
                out[v, u, 1] = (suu * svq - suv * suq) / det


@kernel
def window_of(gray, u, v, weights, values):
    """Weights and values of the window around a pixel; returns the weighted mean and variance."""
    height, width = gray.shape
    half = TAPS // 2
    total = mean = square = 0.0
    center = float(gray[v, u])
    n = 0
    for i in range(-half, half + 1):
        for j in range(-half, half + 1):
            y, x = v + i, u + j
            if y < 0 or x < 0 or y >= height or x >= width:
                weights[n] = 0.0
                values[n] = 0.0
            else:
                value = float(gray[y, x])
                color = (value - center) / COLOR_SIGMA
                space = (i * i + j * j) / (SPACE_SIGMA * SPACE_SIGMA)
                weights[n] = np.exp(-0.5 * (color * color + space))
                values[n] = value
                total += weights[n]
                mean += weights[n] * value
                square += weights[n] * value * value
            n += 1
    mean /= total
    for n in range(TAPS * TAPS):
        weights[n] /= total
        values[n] -= mean
    return max(square / total - mean * mean, 0.0)


@kernel
def cost_in_source(image, view, ray, plane, weights, values, variance):
    """One minus the weighted correlation of the window with a source's image, in [0, 2]; HIDDEN outside the image.

    view = (R (9), t (3), K (fx, fy, cx, cy)) of the source, ray = (x, y, 1 / fx, 1 / fy) of the reference's pixel, plane = (q, dq/du, dq/dv).
    A pixel at offset (du, dv) with inverse depth q + du dq/du + dv dq/dv is at R r + t q in the source, r = (x + du / fx, y + dv / fy, 1).
    """
    r, t, k = view
    x, y, sx, sy = ray
    q, qu, qv = plane
    height, width = image.shape
    bx, by = r[0] * x + r[1] * y + r[2] + t[0] * q, r[3] * x + r[4] * y + r[5] + t[1] * q
    bz = r[6] * x + r[7] * y + r[8] + t[2] * q
    ux, uy, uz = r[0] * sx + t[0] * qu, r[3] * sx + t[1] * qu, r[6] * sx + t[2] * qu
    vx, vy, vz = r[1] * sy + t[0] * qv, r[4] * sy + t[1] * qv, r[7] * sy + t[2] * qv
    half = TAPS // 2
    mean = square = cross = 0.0
    n = 0
    for i in range(-half, half + 1):
        for j in range(-half, half + 1):
            w = weights[n]
            if w > 0.0:
                du, dv = j, i
                z = bz + du * uz + dv * vz
                if not z > 0.0:
                    return HIDDEN
                column = k[0] * (bx + du * ux + dv * vx) / z + k[2]
                row = k[1] * (by + du * uy + dv * vy) / z + k[3]
                if not (column >= 0.0 and row >= 0.0 and column < width - 1 and row < height - 1):
                    return HIDDEN
                c, a = int(column), int(row)
                s, p = column - c, row - a
                top = (1.0 - s) * image[a, c] + s * image[a, c + 1]
                value = (1.0 - p) * top + p * ((1.0 - s) * image[a + 1, c] + s * image[a + 1, c + 1])
                mean += w * value
                square += w * value * value
                cross += w * value * values[n]
            n += 1
    spread = square - mean * mean
    if spread < 0.25 * LEAST_VARIANCE:
        return 1.0
    return 1.0 - cross / np.sqrt(spread * variance)


@kernel
def choose_rows(known, raw, images, views, options, memory, start, stop, out):
    """Choose the inverse depth of each pixel of the zone, in rows start..stop, from its own and those of the pixels at some offsets.

    known = (zone (h, w), inverse depth (h, w), slopes (h, w, 2)), raw (n, h, w): inverse depth of each source. images = (gray of the
    reference (h, w), grays of the sources (n, ...)), views = (K (fx, fy, cx, cy), R (n, 9), t (n, 3), K (n, 4), size (n, 2)). options:
    offsets (m, 2) of rows and columns. memory = (weights, values, hypotheses (k, 3), costs (n)). out = (inverse depth, cost, number of
    sources that match).
    """
    zone, q, slopes = known
    gray, sources = images
    k, r, t, ks, size = views
    weights, values, planes, costs = memory
    chosen, least, matching = out
    for v in range(start, stop):
        for u in range(q.shape[1]):
            chosen[v, u], least[v, u], matching[v, u] = q[v, u], HIDDEN, 0
            if not zone[v, u]:
                continue
            variance = window_of(gray, u, v, weights, values)
            if variance < LEAST_VARIANCE:
                continue
            ray = (u - k[2]) / k[0], (v - k[3]) / k[1], 1.0 / k[0], 1.0 / k[1]
            for h in range(_hypotheses(q, slopes, raw, options, u, v, planes)):
                plane = planes[h, 0], planes[h, 1], planes[h, 2]
                for s in range(len(sources)):
                    image = sources[s][: int(size[s, 1]), : int(size[s, 0])]
                    costs[s] = cost_in_source(
                        image, (r[s], t[s], ks[s]), ray, plane, weights, values, variance
                    )
                cost, number = _combined(costs)
                if cost < least[v, u]:
                    chosen[v, u], least[v, u], matching[v, u] = plane[0], cost, number


@kernel
def _combined(costs):
    """Mean of the two smallest costs, and number of good ones."""
    one = two = HIDDEN
    number = 0
    for s in range(len(costs)):
        c = costs[s]
        number += c < GOOD
        if c < one:
            one, two = c, one
        elif c < two:
            two = c
    return (0.5 * (one + two) if two < HIDDEN else one), number


@kernel
def _hypotheses(q, slopes, raw, offsets, u, v, planes):
    """Distinct planes (q, dq/du, dq/dv) at a pixel: its own, those of its sources, and those of other pixels, extended; returns their number."""
    height, width = q.shape
    count = 0
    if q[v, u] > 0.0:
        planes[0, 0], planes[0, 1], planes[0, 2] = q[v, u], slopes[v, u, 0], slopes[v, u, 1]
        count = 1
    for s in range(len(raw)):
        count = _with(planes, count, raw[s, v, u], slopes[v, u, 0], slopes[v, u, 1])
    for n in range(len(offsets)):
        y, x = v + offsets[n, 0], u + offsets[n, 1]
        if y < 0 or x < 0 or y >= height or x >= width or not q[y, x] > 0.0:
            continue
        su, sv = slopes[y, x, 0], slopes[y, x, 1]
        count = _with(planes, count, q[y, x] - su * offsets[n, 1] - sv * offsets[n, 0], su, sv)
    return count


@kernel
def _with(planes, count, q, su, sv):
    if not q > 0.0 or count == len(planes):
        return count
    for h in range(count):
        if abs(planes[h, 0] - q) <= SAME * q:
            return count
    planes[count, 0], planes[count, 1], planes[count, 2] = q, su, sv
    return count + 1
