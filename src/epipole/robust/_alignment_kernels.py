"""Rigid motions and similarities between two sets of points for the robust loop.

Model: R row by row, t, s. Residual: s R x + t - y, three numbers.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel
from epipole.robust._block_kernels import REASSOC, columns_within, rotate_left
from epipole.robust._contract_kernels import implement
from epipole.solvers._alignment_kernels import SCALE as SCALE
from epipole.solvers._alignment_kernels import align_three_points
from epipole.solvers._linear_kernels import clear, clear_rows, copy_numbers


class AlignmentProblem(NamedTuple):
    """Matched points: rows x (3), y (3)."""

    items: np.ndarray
    """(6, n)."""
    freedom: int
    """7 with scale, 6 without."""


@kernel
def alignment_residuals(p, m, out):
    """Squared distances |s R x + t - y|^2."""
    for k in range(m.shape[1]):
        a, b, c = m[0, k], m[1, k], m[2, k]
        u = p[SCALE] * (p[0] * a + p[1] * b + p[2] * c) + p[9] - m[3, k]
        v = p[SCALE] * (p[3] * a + p[4] * b + p[5] * c) + p[10] - m[4, k]
        w = p[SCALE] * (p[6] * a + p[7] * b + p[8] * c) + p[11] - m[5, k]
        out[k] = u * u + v * v + w * w


@kernel(extra_fastmath=REASSOC)
def _sum_block(p, m, threshold_sq, start, stop):
    """(number of items within the threshold, truncated sum of squares)."""
    s = p[SCALE]
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8]
    t0, t1, t2 = p[9], p[10], p[11]
    count, total = 0, 0.0
    for k in range(start, stop):
        a, b, c = m[0, k], m[1, k], m[2, k]
        u = s * (r0 * a + r1 * b + r2 * c) + t0 - m[3, k]
        v = s * (r3 * a + r4 * b + r5 * c) + t1 - m[4, k]
        w = s * (r6 * a + r7 * b + r8 * c) + t2 - m[5, k]
        r = u * u + v * v + w * w
        count += 1 if r < threshold_sq else 0
        total += r if r < threshold_sq else threshold_sq
    return count, total


@kernel(allocates=True)
def alignment_normal_equations(p, m, threshold_sq, soft_sq, freedom, a, b):
    """Gauss-Newton terms in (t, rotation from the left, log s) over the items within the threshold; the score."""
    n, total = m.shape[1], 0.0
    clear_rows(a)
    clear(b)
    for k in range(n):
        x, y, z = m[0, k], m[1, k], m[2, k]
        gx = p[SCALE] * (p[0] * x + p[1] * y + p[2] * z)
        gy = p[SCALE] * (p[3] * x + p[4] * y + p[5] * z)
        gz = p[SCALE] * (p[6] * x + p[7] * y + p[8] * z)
        u, v, w = gx + p[9] - m[3, k], gy + p[10] - m[4, k], gz + p[11] - m[5, k]
        r = u * u + v * v + w * w
        total += min(r, threshold_sq)
        q = 1.0 / (1.0 + r / soft_sq) if r < threshold_sq else 0.0
        # d/dt = I, d/dphi = -[g]x, d/dlog s = g.
        for i in range(3):
            a[i, i] += q
        a[3, 1], a[3, 2], a[4, 0] = a[3, 1] - q * gz, a[3, 2] + q * gy, a[4, 0] + q * gz
        a[4, 2], a[5, 0], a[5, 1] = a[4, 2] - q * gx, a[5, 0] - q * gy, a[5, 1] + q * gx
        a[3, 3] += q * (gy * gy + gz * gz)
        a[4, 4] += q * (gx * gx + gz * gz)
        a[5, 5] += q * (gx * gx + gy * gy)
        a[4, 3] -= q * gx * gy
        a[5, 3] -= q * gx * gz
        a[5, 4] -= q * gy * gz
        b[0], b[1], b[2] = b[0] + q * u, b[1] + q * v, b[2] + q * w
        b[3] += q * (gy * w - gz * v)
        b[4] += q * (gz * u - gx * w)
        b[5] += q * (gx * v - gy * u)
        if freedom == 7:
            a[6, 0], a[6, 1], a[6, 2] = a[6, 0] + q * gx, a[6, 1] + q * gy, a[6, 2] + q * gz
            a[6, 6] += q * (gx * gx + gy * gy + gz * gz)
            b[6] += q * (gx * u + gy * v + gz * w)
    for i in range(freedom):
        for j in range(i):
            a[j, i] = a[i, j]
    return total


@kernel
def _retract_alignment(model, delta, freedom, out):
    rotate_left(delta[3:6], model, out)
    for i in range(3):
        out[9 + i] = model[9 + i] + delta[i]
    out[SCALE] = model[SCALE] * math.exp(delta[6]) if freedom == 7 else model[SCALE]


def _sample_size(problem):
    return np.int64(3)


def _num_items(problem):
    return problem.items.shape[1]


def _degrees_of_freedom(problem):
    return problem.freedom


def _workspace(problem):
    return np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))


def _solve_sample(problem, sample, models, work):
    x, y, a, b = work
    for k in range(3):
        for i in range(3):
            x[k, i], y[k, i] = problem.items[i, sample[k]], problem.items[3 + i, sample[k]]
    return 1 if align_three_points(x, y, problem.freedom == 7, a, b, models[0]) else 0


def _agreeing(problem, model, threshold_sq, start, stop):
    return _sum_block(model, problem.items, threshold_sq, start, stop)[0]


def _settle(problem, sample, model, settled, work):
    copy_numbers(model, settled[0])
    return 1


def _score(problem, model, threshold_sq, bail_out):
    return _sum_block(model, problem.items, threshold_sq, 0, problem.items.shape[1])[1]


def _residuals_sq(problem, model, threshold_sq, out):
    alignment_residuals(model, problem.items, out)


def _residual_size(problem):
    return np.int64(3)


def _near(problem, model, threshold_sq):
    residuals = np.empty(problem.items.shape[1])
    alignment_residuals(model, problem.items, residuals)
    return AlignmentProblem(columns_within(problem.items, residuals, threshold_sq), problem.freedom)


def _linearize(problem, model, threshold_sq, soft_sq, a, b):
    return alignment_normal_equations(model, problem.items, threshold_sq, soft_sq, problem.freedom, a, b)


def _retract(problem, model, delta, out):
    _retract_alignment(model, delta, problem.freedom, out)


implement(
    AlignmentProblem,
    sample_size=_sample_size,
    num_items=_num_items,
    degrees_of_freedom=_degrees_of_freedom,
    workspace=_workspace,
    solve_sample=_solve_sample,
    agreeing=_agreeing,
    settle=_settle,
    score=_score,
    residuals_sq=_residuals_sq,
    near=_near,
    residual_size=_residual_size,
    linearize=_linearize,
    retract=_retract,
)
