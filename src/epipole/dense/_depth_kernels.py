"""Depth of a view from several sources: sampling of rectified disparities, and their combination by agreement."""

import numpy as np

from epipole._jit import kernel

OK, OUT_OF_VIEW, OCCLUDED, TEXTURELESS, AMBIGUOUS, DISAGREEING, UNCERTAIN, MASKED = 0, 1, 2, 3, 4, 5, 6, 7
LARGEST_STEP_PX = np.float32(1.0)
"""Largest difference of the four disparities around a position that are interpolated."""


@kernel
def sample_pair(geometry, found, limits, start, stop, out):
    """Inverse depth of rows start..stop of the reference view, from the disparities of a rectified pair.

    geometry = (rectified pixel from reference pixel (9), n (3), d0, K of the reference (fx, fy, cx, cy)), found = (disparity, sigma,
    reason), limits = (reason of each value of found, extra sigma). out = (inverse depth, sigma, reason) of this pair.
    q = (d + d0) (n . r), r = ((u - cx) / fx, (v - cy) / fy, 1).
    """
    h, n, first, k = geometry
    disparity, sigma, reason = found
    names, extra = limits
    inverse, spread, why = out
    height, width = disparity.shape
    nan = np.float32(np.nan)
    for v in range(start, stop):
        for u in range(inverse.shape[1]):
            inverse[v, u], spread[v, u], why[v, u] = nan, nan, OUT_OF_VIEW
            w = h[6] * u + h[7] * v + h[8]
            if w <= 0.0:
                continue
            x, y = (h[0] * u + h[1] * v + h[2]) / w, (h[3] * u + h[4] * v + h[5]) / w
            if not (x > -0.5 and y > -0.5 and x < width - 0.5 and y < height - 0.5):
                continue
            column, row = int(x + 0.5), int(y + 0.5)
            why[v, u] = names[reason[row, column]]
            if why[v, u] != OK:
                continue
            d = disparity[row, column]
            c, r = min(max(int(x), 0), width - 2), min(max(int(y), 0), height - 2)
            a00, a01 = disparity[r, c], disparity[r, c + 1]
            a10, a11 = disparity[r + 1, c], disparity[r + 1, c + 1]
            if (
                abs(a00 - d) < LARGEST_STEP_PX
                and abs(a01 - d) < LARGEST_STEP_PX
                and abs(a10 - d) < LARGEST_STEP_PX
                and abs(a11 - d) < LARGEST_STEP_PX
            ):
                s, t = np.float32(x - c), np.float32(y - r)
                d = (1 - t) * ((1 - s) * a00 + s * a01) + t * ((1 - s) * a10 + s * a11)
            scale = n[0] * ((u - k[2]) / k[0]) + n[1] * ((v - k[3]) / k[1]) + n[2]
            q = (d + first) * scale
            if not q > 0.0:
                why[v, u] = OUT_OF_VIEW
                continue
            inverse[v, u] = q
            spread[v, u] = scale * np.sqrt(sigma[row, column] ** 2 + extra**2)


@kernel
def merge_rows(inverse, spread, why, views, options, start, stop, out):
    """Combine the inverse depths (n, h, w) of rows start..stop by agreement.

    Two sources agree if they differ by at most `width` times their combined standard deviation, or by the fraction `floor`. The largest
    group that agrees with one source gives the weighted mean, the standard deviation of independent errors, and the chi-square of the
    group. options = (width, floor), out = (inverse depth, sigma, chi-square, number agreeing, number differing, number of sources in whose
    image the point is, reason). views = (K of the reference (fx, fy, cx, cy), R (n, 9), t (n, 3), K (n, 4), size (n, 2)) of the sources.
    """
    width, floor = options
    merged, sigma, chi_square, agreeing, differing, seeing, reason = out
    count = inverse.shape[0]
    nan = np.float32(np.nan)
    for v in range(start, stop):
        for u in range(inverse.shape[2]):
            best, best_weight = -1, 0.0
            num = 0
            seeing[v, u] = 0
            for i in range(count):
                q = inverse[i, v, u]
                if not np.isfinite(q):
                    continue
                num += 1
                weight = 0.0
                for j in range(count):
                    p = inverse[j, v, u]
                    if not np.isfinite(p):
                        continue
                    both = width * np.sqrt(spread[i, v, u] ** 2 + spread[j, v, u] ** 2) + floor * q
                    if abs(p - q) <= both:
                        weight += 1.0 + 1e-3 * q / (spread[j, v, u] + 1e-3 * q)
                if weight > best_weight:
                    best, best_weight = i, weight
            merged[v, u], sigma[v, u], chi_square[v, u] = nan, nan, nan
            agreeing[v, u], differing[v, u] = 0, 0
            if best < 0:
                reason[v, u] = _commonest(why[:, v, u])
                continue
            q, s = inverse[best, v, u], spread[best, v, u]
            mean, total, chi, number = _mean_near(inverse, spread, u, v, q, s, options)
            merged[v, u], sigma[v, u], chi_square[v, u] = mean, 1.0 / np.sqrt(total), chi
            agreeing[v, u], differing[v, u], reason[v, u] = number, num - number, OK
            seeing[v, u] = _num_in_view(views, u, v, mean)


@kernel
def merge_near_rows(inverse, spread, zone, chosen, options, start, stop, out):
    """In the zone, combine the sources that agree with the chosen inverse depth instead; out and options as in `merge_rows`, without counts of views."""
    merged, sigma, chi_square, agreeing = out
    for v in range(start, stop):
        for u in range(inverse.shape[2]):
            if not zone[v, u]:
                continue
            mean, total, chi, number = _mean_near(
                inverse, spread, u, v, chosen[v, u], np.float32(0.0), options
            )
            agreeing[v, u] = number
            if number:
                merged[v, u], sigma[v, u], chi_square[v, u] = mean, 1.0 / np.sqrt(total), chi


@kernel
def _mean_near(inverse, spread, u, v, q, s, options):
    """Weighted mean of the inverse depths that agree with q of standard deviation s; sum of weights, chi-square and number."""
    width, floor = options
    total, mean, chi, number = 0.0, 0.0, 0.0, 0
    for j in range(inverse.shape[0]):
        p = inverse[j, v, u]
        if np.isfinite(p) and abs(p - q) <= width * np.sqrt(s**2 + spread[j, v, u] ** 2) + floor * q:
            one = 1.0 / spread[j, v, u] ** 2
            total, mean, number = total + one, mean + one * p, number + 1
    if number:
        mean /= total
    for j in range(inverse.shape[0]):
        p = inverse[j, v, u]
        if np.isfinite(p) and abs(p - q) <= width * np.sqrt(s**2 + spread[j, v, u] ** 2) + floor * q:
            chi += ((p - mean) / spread[j, v, u]) ** 2
    return mean, total, chi, number


@kernel
def _num_in_view(views, u, v, q):
    """Number of sources in whose image the point at inverse depth q of pixel (u, v) is."""
    k, r, t, ks, size = views
    x, y = (u - k[2]) / k[0], (v - k[3]) / k[1]
    number = 0
    for i in range(len(r)):
        z = r[i, 6] * x + r[i, 7] * y + r[i, 8] + t[i, 2] * q
        if not z > 0.0:
            continue
        column = ks[i, 0] * (r[i, 0] * x + r[i, 1] * y + r[i, 2] + t[i, 0] * q) / z + ks[i, 2]
        row = ks[i, 1] * (r[i, 3] * x + r[i, 4] * y + r[i, 5] + t[i, 1] * q) / z + ks[i, 3]
        number += column > -0.5 and row > -0.5 and column < size[i, 0] - 0.5 and row < size[i, 1] - 0.5
    return number


@kernel
def _commonest(why):
    """The reason that most sources have; the smallest of several."""
    best, most = OUT_OF_VIEW, 0
    for value in range(1, 8):
        number = 0
        for k in range(len(why)):
            number += why[k] == value
        if number > most:
            best, most = value, number
    return best
