"""Fundamental matrices for scenes with a dominant plane (Chum, Werner and Matas, CVPR 2005: DEGENSAC).

Every F = [e2]x H fits the matches of a plane with homography H. If most matches lie on one plane, samples give an F that
is right for the plane and wrong elsewhere. Such an F still determines H; two matches off the plane then fix the
epipole e2.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.robust._item_kernels import median, sampson_agreeing
from epipole.robust._loop_kernels import sample_items
from epipole.solvers._linear_kernels import clear, clear_rows, copy_numbers, solve_spd

PLANE_SAMPLES, PLANE_TESTED = 40, 128
DOMINANT = 0.6  # inlier fraction on a plane above which F may be degenerate
OFF_PLANE = 2.0  # distance from the plane, in thresholds, beyond which a match has parallax
OFF_NOISE = 3.5  # the same, in standard deviations of the plane's noise
PARALLAX_SAMPLES, CONFIDENCE = 2000, 0.999
SHIFTS = 5  # wrong pairings per match, to measure chance agreement


@kernel
def _add_plane_terms(f, e2, m, k, a, b):
    """Normal equations for v in H = [e2]x F - e2 v^T: x2 x H x1 = 0 is (x2 x [e2]x F x1) = (x2 x e2) (v . x1)."""
    x, y, u, w = m[0, k], m[1, k], m[2, k], m[3, k]
    l0, l1, l2 = f[0] * x + f[1] * y + f[2], f[3] * x + f[4] * y + f[5], f[6] * x + f[7] * y + f[8]
    q0, q1, q2 = e2[1] * l2 - e2[2] * l1, e2[2] * l0 - e2[0] * l2, e2[0] * l1 - e2[1] * l0
    d0, d1, d2 = w * e2[2] - e2[1], e2[0] - u * e2[2], u * e2[1] - w * e2[0]
    size = d0 * d0 + d1 * d1 + d2 * d2
    along = (w * q2 - q1) * d0 + (q0 - u * q2) * d1 + (u * q1 - w * q0) * d2
    a[0, 0] += size * x * x
    a[1, 0] += size * y * x
    a[1, 1] += size * y * y
    a[2, 0] += size * x
    a[2, 1] += size * y
    a[2, 2] += size
    b[0] += along * x
    b[1] += along * y
    b[2] += along


@kernel
def _solve_plane(f, e2, a, b, h):
    """H from the normal equations; False if they are singular."""
    if not solve_spd(a, b, 3):
        return False
    for i in range(3):
        p, q = 3 * ((i + 1) % 3), 3 * ((i + 2) % 3)
        for j in range(3):
            h[3 * i + j] = e2[(i + 1) % 3] * f[q + j] - e2[(i + 2) % 3] * f[p + j] - e2[i] * b[j]
    return True


@kernel
def _transfer_sq(h, m, k):
    """Squared distance between H x1 and x2."""
    x, y = m[0, k], m[1, k]
    w = h[6] * x + h[7] * y + h[8]
    u, v = (h[0] * x + h[1] * y + h[2]) / w - m[2, k], (h[3] * x + h[4] * y + h[5]) / w - m[3, k]
    d = u * u + v * v
    return d if d < math.inf else math.inf


@kernel(allocates=True)
def find_plane(f, e2, m, residuals, threshold_sq, state, h):
    """H of the plane that contains most of the matches with small residuals.

    Returns (fraction of those matches, squared distance beyond which a match is off the plane).
    """
    n = m.shape[1]
    inliers, count = np.empty(n, np.int64), 0
    for k in range(n):
        if residuals[k] < threshold_sq:
            inliers[count] = k
            count += 1
    if count < 7:
        return 0.0, math.inf
    a, b, tried, sample = np.empty((3, 3)), np.empty(3), np.empty(9), np.empty(3, np.int64)
    best, tested, reach_sq = 0, min(count, PLANE_TESTED), OFF_PLANE * OFF_PLANE * threshold_sq
    for _ in range(PLANE_SAMPLES):
        sample_items(state, count, 3, sample)
        clear_rows(a)
        clear(b)
        for i in range(3):
            _add_plane_terms(f, e2, m, inliers[sample[i]], a, b)
        if not _solve_plane(f, e2, a, b, tried):
            continue
        agreed = 0
        for i in range(tested):
            agreed += 1 if _transfer_sq(tried, m, inliers[i]) < reach_sq else 0
        if agreed > best:
            best = agreed
            copy_numbers(tried, h)
    if best < DOMINANT * tested:
        return best / tested, reach_sq
    distances = np.empty(count)
    for _ in range(2):
        clear_rows(a)
        clear(b)
        for i in range(count):
            if _transfer_sq(h, m, inliers[i]) < reach_sq:
                _add_plane_terms(f, e2, m, inliers[i], a, b)
        _solve_plane(f, e2, a, b, h)
        for i in range(count):
            distances[i] = _transfer_sq(h, m, inliers[i])
        # The median of the sum of two squares of normal variables is 1.386 variances.
        noise_sq = median(distances, count) / 1.386
        reach_sq = max(OFF_PLANE * OFF_PLANE * threshold_sq, OFF_NOISE * OFF_NOISE * noise_sq)
    agreed = 0
    for i in range(count):
        agreed += 1 if _transfer_sq(h, m, inliers[i]) < reach_sq else 0
    return agreed / count, reach_sq


@kernel(allocates=True)
def off_plane(h, m, reach_sq):
    """The matches with a transfer error above the given distance."""
    count = 0
    for k in range(m.shape[1]):
        count += 1 if _transfer_sq(h, m, k) > reach_sq else 0
    out, position = np.empty((4, count)), 0
    for k in range(m.shape[1]):
        if _transfer_sq(h, m, k) > reach_sq:
            for i in range(4):
                out[i, position] = m[i, k]
            position += 1
    return out


@kernel
def _parallax_line(h, m, k, line):
    """The line through H x1 and x2, which passes through e2."""
    x, y = m[0, k], m[1, k]
    a, b, c = h[0] * x + h[1] * y + h[2], h[3] * x + h[4] * y + h[5], h[6] * x + h[7] * y + h[8]
    line[0], line[1], line[2] = b - c * m[3, k], c * m[2, k] - a, a * m[3, k] - b * m[2, k]


@kernel(allocates=True)
def plane_and_parallax(h, off, threshold_sq, state, f):
    """F = [e2]x H with the epipole on most parallax lines of the matches `off` the plane; returns their number."""
    n = off.shape[1]
    if n < 2:
        return 0
    one, two, e2, tried = np.empty(3), np.empty(3), np.empty(3), np.empty(9)
    sample = np.empty(2, np.int64)
    best, iteration, needed = 0, 0, PARALLAX_SAMPLES
    while iteration < needed:
        iteration += 1
        sample_items(state, n, 2, sample)
        _parallax_line(h, off, sample[0], one)
        _parallax_line(h, off, sample[1], two)
        size = 0.0
        for i in range(3):
            p, q = (i + 1) % 3, (i + 2) % 3
            e2[i] = one[p] * two[q] - one[q] * two[p]
            size += e2[i] * e2[i]
        if not size > 1e-300:
            continue
        norm = 0.0
        for i in range(3):
            p, q = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                tried[3 * i + j] = (e2[p] * h[3 * q + j] - e2[q] * h[3 * p + j]) / math.sqrt(size)
                norm += tried[3 * i + j] ** 2
        if not (norm > 1e-300 and norm < math.inf):
            continue
        agreed = sampson_agreeing(tried, off, threshold_sq, 0, n)
        if agreed > best:
            best = agreed
            for i in range(9):
                f[i] = tried[i] / math.sqrt(norm)
            miss = 1.0 - (agreed / n) ** 2
            if miss <= 0.0:
                break
            needed = min(needed, int(math.log(1.0 - CONFIDENCE) / math.log(miss)) + 1)
    return best


@kernel(allocates=True)
def chance_of_agreement(f, m, threshold_sq):
    """Probability that unrelated points agree with F, measured by pairing each point with the next few partners."""
    n, agreed = m.shape[1], 0
    wrong = np.empty((4, n))
    for shift in range(1, SHIFTS + 1):
        for k in range(n):
            wrong[0, k], wrong[1, k] = m[0, k], m[1, k]
            wrong[2, k], wrong[3, k] = m[2, (k + shift) % n], m[3, (k + shift) % n]
        agreed += sampson_agreeing(f, wrong, threshold_sq, 0, n)
    return (agreed + 1.0) / (SHIFTS * n + 1.0)
