"""Relative pose of calibrated cameras for the robust loop.

Model: motion (R row by row, t), |t| = 1, then E. Residual: Sampson's first-order distance (1982; HZ eq. 11.9),
    r = e / sqrt(m), e = x2^T E x1, m = |(E x1)_12|^2 + |(E^T x2)_12|^2, E = [t]x R,
for matches that both cameras see in front of them; others are as far as can be. Rays that are parallel to
within the threshold count as in front: far points have depths of either sign.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel
from epipole.robust._block_kernels import (
    BLOCK,
    REASSOC,
    add_normal_equations,
    columns_within,
    gather,
    rotate_left,
    sampson_agreeing,
)
from epipole.robust._contract_kernels import implement
from epipole.solvers._linear_kernels import clear, clear_rows, copy_numbers
from epipole.solvers._two_view_kernels import (
    essential_five_point,
    essential_from_motion,
    five_point_workspace,
    motions_from_essential,
)


class RelativePoseProblem(NamedTuple):
    """Matches on the planes z = 1, rows u1, v1, u2, v2."""

    matches: np.ndarray  # (4, n)


@kernel(extra_fastmath=REASSOC)
def _score_block(p, m, start, stop, threshold_sq):
    """Truncated sum over matches start..stop; p = motion, then E."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8]
    tx, ty, tz = p[9], p[10], p[11]
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = p[12], p[13], p[14], p[15], p[16], p[17], p[18], p[19], p[20]
    slack, total = math.sqrt(threshold_sq), 0.0
    for k in range(start, stop):
        a, b, c, d = m[0, k], m[1, k], m[2, k], m[3, k]
        l0, l1, l2 = f0 * a + f1 * b + f2, f3 * a + f4 * b + f5, f6 * a + f7 * b + f8
        g0, g1 = f0 * c + f3 * d + f6, f1 * c + f4 * d + f7
        e = c * l0 + d * l1 + l2
        r = e * e / (l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300)
        x, y, z = r0 * a + r1 * b + r2, r3 * a + r4 * b + r5, r6 * a + r7 * b + r8
        xx, yy, xy = x * x + y * y + z * z, c * c + d * d + 1.0, x * c + y * d + z
        xt, yt = x * tx + y * ty + z * tz, c * tx + d * ty + tz
        # Depths along both rays, times a positive determinant (see `is_in_front`).
        least = -slack * xx * yy
        behind = xy * yt - yy * xt < least or xx * yt - xy * xt < least
        total += threshold_sq if behind or r > threshold_sq else r
    return total


@kernel
def relative_residuals(model, m, slack, out):
    """Squared Sampson distances; infinite where rays diverge by more than `slack`."""
    for k in range(m.shape[1]):
        x1, y1, x2, y2 = m[0, k], m[1, k], m[2, k], m[3, k]
        l0, l1 = model[12] * x1 + model[13] * y1 + model[14], model[15] * x1 + model[16] * y1 + model[17]
        l2 = model[18] * x1 + model[19] * y1 + model[20]
        g0, g1 = model[12] * x2 + model[15] * y2 + model[18], model[13] * x2 + model[16] * y2 + model[19]
        e = x2 * l0 + y2 * l1 + l2
        r = e * e / (l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300)
        x = model[0] * x1 + model[1] * y1 + model[2]
        y = model[3] * x1 + model[4] * y1 + model[5]
        z = model[6] * x1 + model[7] * y1 + model[8]
        xx, yy, xy = x * x + y * y + z * z, x2 * x2 + y2 * y2 + 1.0, x * x2 + y * y2 + z
        xt = x * model[9] + y * model[10] + z * model[11]
        yt = x2 * model[9] + y2 * model[10] + model[11]
        least = -slack * xx * yy
        out[k] = math.inf if xy * yt - yy * xt < least or xx * yt - xy * xt < least else r


@kernel
def tangent_of_direction(t, basis):
    """Two unit vectors (rows of basis) orthogonal to t and to each other."""
    c = 0
    if abs(t[1]) < abs(t[c]):
        c = 1
    if abs(t[2]) < abs(t[c]):
        c = 2
    dot = t[c]
    norm = 0.0
    for i in range(3):
        basis[0, i] = (1.0 if i == c else 0.0) - dot * t[i]
        norm += basis[0, i] ** 2
    norm = 1.0 / math.sqrt(norm)
    for i in range(3):
        basis[0, i] *= norm
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        basis[1, i] = t[j] * basis[0, k] - t[k] * basis[0, j]


@kernel(allocates=True)
def derivatives_of_essential(model, d):
    """D (5, 9): E = [t]x R by a rotation from the left and a step of t on the unit sphere."""
    moved, basis = np.zeros(12), np.empty((2, 3))
    for i in range(9, 12):
        moved[i] = model[i]
    for w in range(3):
        p, q = (w + 1) % 3, (w + 2) % 3
        for j in range(3):  # [e_w]x R
            moved[3 * w + j], moved[3 * p + j], moved[3 * q + j] = 0.0, -model[3 * q + j], model[3 * p + j]
        essential_from_motion(moved, d[w])
    tangent_of_direction(model[9:12], basis)
    for i in range(9):
        moved[i] = model[i]
    for c in range(2):
        for i in range(3):
            moved[9 + i] = basis[c, i]
        essential_from_motion(moved, d[3 + c])


@kernel(extra_fastmath=REASSOC)
def _rows_of_block(p, m, start, stop, threshold_sq, soft_sq, rows):
    """Residuals (rows[0]) and their derivatives (rows[1:6]) of matches start..stop, zero where truncated."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8]
    tx, ty, tz = p[9], p[10], p[11]
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = p[12], p[13], p[14], p[15], p[16], p[17], p[18], p[19], p[20]
    slack, total = math.sqrt(threshold_sq), 0.0
    for k in range(start, stop):
        a, b, c, e2 = m[0, k], m[1, k], m[2, k], m[3, k]
        l0, l1, l2 = f0 * a + f1 * b + f2, f3 * a + f4 * b + f5, f6 * a + f7 * b + f8
        g0, g1 = f0 * c + f3 * e2 + f6, f1 * c + f4 * e2 + f7
        e = c * l0 + e2 * l1 + l2
        inverse = 1.0 / (l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300)
        r = e * e * inverse
        x, y, z = r0 * a + r1 * b + r2, r3 * a + r4 * b + r5, r6 * a + r7 * b + r8
        xx, yy, xy = x * x + y * y + z * z, c * c + e2 * e2 + 1.0, x * c + y * e2 + z
        xt, yt = x * tx + y * ty + z * tz, c * tx + e2 * ty + tz
        least = -slack * xx * yy
        behind = xy * yt - yy * xt < least or xx * yt - xy * xt < least
        is_out = behind or r > threshold_sq
        total += threshold_sq if is_out else r
        root = 0.0 if is_out else math.sqrt(inverse / (1.0 + r / soft_sq))
        ratio = e * inverse
        # dr / dE_ij = (x2_i x1_j - (e / m) ([i < 2] (E x1)_i x1_j + [j < 2] (E^T x2)_j x2_i)) / sqrt(m)
        u, v = c - ratio * l0, e2 - ratio * l1
        h0, h1 = ratio * g0, ratio * g1
        i = k - start
        rows[0, i] = root * e
        rows[1, i], rows[2, i], rows[3, i] = root * (u * a - h0 * c), root * (u * b - h1 * c), root * u
        rows[4, i], rows[5, i], rows[6, i] = root * (v * a - h0 * e2), root * (v * b - h1 * e2), root * v
        rows[7, i], rows[8, i], rows[9, i] = root * (a - h0), root * (b - h1), root
    return total


def _sample_size(problem):
    return np.int64(5)


def _num_items(problem):
    return problem.matches.shape[1]


def _workspace(problem):
    return np.empty((5, 3)), np.empty((5, 3)), np.empty((10, 9)), np.empty((4, 12)), five_point_workspace()


def _residual_size(problem):
    return np.int64(1)


def _retract(problem, model, delta, out):
    basis = np.empty((2, 3))
    rotate_left(delta, model, out)
    tangent_of_direction(model[9:12], basis)
    norm = 0.0
    for i in range(3):
        out[9 + i] = model[9 + i] + delta[3] * basis[0, i] + delta[4] * basis[1, i]
        norm += out[9 + i] ** 2
    norm = 1.0 / math.sqrt(norm)
    for i in range(3):
        out[9 + i] *= norm
    essential_from_motion(out, out[12:21])


def contract_of_motions(kind, rays_of, agreeing_block, score_block, rows_of_block, residuals_of):
    """The contract of relative poses whose matches are kept as `kind` keeps them, given what looks at a match."""

    def solve_sample(problem, sample, models, work):
        y1, y2, essentials, _, solver = work
        rays_of(problem.matches, sample, y1, y2)
        count = essential_five_point(y1, y2, essentials, solver)
        for k in range(count):
            for i in range(9):
                models[k, 12 + i] = essentials[k, i]
        return count

    def agreeing(problem, model, threshold_sq, start, stop):
        return agreeing_block(model[12:21], problem.matches, threshold_sq, start, stop)

    def settle(problem, sample, model, settled, work):
        # Those of the four motions of E that put the sample in front.
        y1, y2, _, motions, _ = work
        rays_of(problem.matches, sample, y1, y2)
        count = motions_from_essential(model[12:21], y1, y2, motions)
        for c in range(count):
            copy_numbers(motions[c], settled[c])
            essential_from_motion(settled[c], settled[c, 12:21])
        return count

    def score(problem, model, threshold_sq, bail_out):
        matches, total = problem.matches, 0.0
        n = matches.shape[1]
        for start in range(0, n, BLOCK):
            total += score_block(model, matches, start, min(start + BLOCK, n), threshold_sq)
            if total > bail_out:
                break
        return total

    def residuals_sq(problem, model, threshold_sq, out):
        residuals_of(model, problem.matches, math.sqrt(threshold_sq), out)

    def near(problem, model, threshold_sq):
        residuals = np.empty(problem.matches.shape[1])
        residuals_of(model, problem.matches, math.sqrt(threshold_sq), residuals)
        return kind(columns_within(problem.matches, residuals, threshold_sq))

    def linearize(problem, model, threshold_sq, soft_sq, a, b):
        size = 5
        d, rows, jac = np.empty((size, 9)), np.empty((10, BLOCK)), np.empty((size, BLOCK))
        clear_rows(a)
        clear(b)
        derivatives_of_essential(model, d)
        matches, total = problem.matches, 0.0
        n = matches.shape[1]
        for start in range(0, n, BLOCK):
            stop = min(start + BLOCK, n)
            total += rows_of_block(model, matches, start, stop, threshold_sq, soft_sq, rows)
            add_normal_equations(d, rows, jac, stop - start, a, b)
        for i in range(size):
            for j in range(i):
                a[j, i] = a[i, j]
        return total

    return {
        "sample_size": _sample_size,
        "num_items": _num_items,
        "degrees_of_freedom": _sample_size,
        "workspace": _workspace,
        "solve_sample": solve_sample,
        "agreeing": agreeing,
        "settle": settle,
        "score": score,
        "residuals_sq": residuals_sq,
        "near": near,
        "residual_size": _residual_size,
        "linearize": linearize,
        "retract": _retract,
    }


RELATIVE_POSE = contract_of_motions(
    RelativePoseProblem, gather, sampson_agreeing, _score_block, _rows_of_block, relative_residuals
)
implement(RelativePoseProblem, **RELATIVE_POSE)
