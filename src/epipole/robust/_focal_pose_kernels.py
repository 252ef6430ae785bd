"""Absolute pose and focal length of an undistorted camera for the robust loop.

Model: R row by row, t, f. Residual: f (x / z, y / z) - (u, v), pixels counted from the principal point.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel
from epipole.robust._absolute_pose_kernels import retract_motion
from epipole.robust._block_kernels import BLOCK, REASSOC, columns_within, dot_rows
from epipole.robust._contract_kernels import implement
from epipole.solvers._linear_kernels import clear, clear_rows, copy_numbers
from epipole.solvers._more_pose_kernels import FOCAL as FOCAL
from epipole.solvers._more_pose_kernels import p4pf, p4pf_workspace


class FocalPoseProblem(NamedTuple):
    """Points of order one, rows X (3), u, v; pixels in units of the picture."""

    items: np.ndarray
    """(5, n)."""


@kernel(extra_fastmath=REASSOC)
def _sum_block(p, m, threshold_sq, start, stop):
    """(number of items within the threshold, truncated sum of squares)."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8]
    t0, t1, t2, f = p[9], p[10], p[11], p[FOCAL]
    count, total = 0, 0.0
    for k in range(start, stop):
        a, b, c = m[0, k], m[1, k], m[2, k]
        z = r6 * a + r7 * b + r8 * c + t2
        u = f * (r0 * a + r1 * b + r2 * c + t0) - z * m[3, k]
        v = f * (r3 * a + r4 * b + r5 * c + t1) - z * m[4, k]
        r = (u * u + v * v) / (z * z + 1e-300)
        is_in = z > 0.0 and r < threshold_sq
        count += 1 if is_in else 0
        total += r if is_in else threshold_sq
    return count, total


@kernel
def focal_residuals(p, m, out):
    """Squared residuals; infinite behind the camera."""
    for k in range(m.shape[1]):
        a, b, c = m[0, k], m[1, k], m[2, k]
        z = p[6] * a + p[7] * b + p[8] * c + p[11]
        u = p[FOCAL] * (p[0] * a + p[1] * b + p[2] * c + p[9]) - z * m[3, k]
        v = p[FOCAL] * (p[3] * a + p[4] * b + p[5] * c + p[10]) - z * m[4, k]
        out[k] = (u * u + v * v) / (z * z) if z > 0.0 else math.inf


@kernel(extra_fastmath=REASSOC)
def _rows_of_block(p, m, threshold_sq, soft_sq, start, stop, rows):
    """Residuals (rows 0, 8) and derivatives by (translation, rotation, log f) (1:8, 9:16), zero where truncated."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8]
    t0, t1, t2, f = p[9], p[10], p[11], p[FOCAL]
    total = 0.0
    for k in range(start, stop):
        a, b, c = m[0, k], m[1, k], m[2, k]
        x = r0 * a + r1 * b + r2 * c + t0
        y = r3 * a + r4 * b + r5 * c + t1
        z = r6 * a + r7 * b + r8 * c + t2
        inverse = 1.0 / (z if z > 0.0 else 1.0)
        u, v = f * x * inverse, f * y * inverse
        du, dv = u - m[3, k], v - m[4, k]
        r = du * du + dv * dv
        is_in = z > 0.0 and r < threshold_sq
        total += r if is_in else threshold_sq
        keep, i = (math.sqrt(1.0 / (1.0 + r / soft_sq)) if is_in else 0.0), k - start
        g, gu, gv = keep * f * inverse, keep * u * inverse, keep * v * inverse
        # d(u, v)/dx = (g, 0, -gu), (0, g, -gv); dx/dphi = -[x]x.
        rows[0, i] = keep * du
        rows[1, i], rows[2, i], rows[3, i] = g, 0.0, -gu
        rows[4, i], rows[5, i], rows[6, i] = -y * gu, z * g + x * gu, -y * g
        rows[7, i] = keep * u
        rows[8, i] = keep * dv
        rows[9, i], rows[10, i], rows[11, i] = 0.0, g, -gv
        rows[12, i], rows[13, i], rows[14, i] = -z * g - y * gv, x * gv, x * g
        rows[15, i] = keep * v
    return total


def _sample_size(problem):
    return np.int64(4)


def _num_items(problem):
    return problem.items.shape[1]


def _degrees_of_freedom(problem):
    return np.int64(7)


def _workspace(problem):
    return np.empty((4, 2)), np.empty((4, 3)), np.empty((8, 13)), p4pf_workspace()


def _solve_sample(problem, sample, models, work):
    pixels, points, found, solver = work
    for k in range(4):
        for i in range(3):
            points[k, i] = problem.items[i, sample[k]]
        pixels[k, 0], pixels[k, 1] = problem.items[3, sample[k]], problem.items[4, sample[k]]
    count = p4pf(pixels, points, found, solver)
    for k in range(count):
        copy_numbers(found[k], models[k])
    return count


def _agreeing(problem, model, threshold_sq, start, stop):
    return _sum_block(model, problem.items, threshold_sq, start, stop)[0]


def _settle(problem, sample, model, settled, work):
    copy_numbers(model, settled[0])
    return 1


def _score(problem, model, threshold_sq, bail_out):
    return _sum_block(model, problem.items, threshold_sq, 0, problem.items.shape[1])[1]


def _residuals_sq(problem, model, threshold_sq, out):
    focal_residuals(model, problem.items, out)


def _residual_size(problem):
    return np.int64(2)


def _near(problem, model, threshold_sq):
    residuals = np.empty(problem.items.shape[1])
    focal_residuals(model, problem.items, residuals)
    return FocalPoseProblem(columns_within(problem.items, residuals, threshold_sq))


def _linearize(problem, model, threshold_sq, soft_sq, a, b):
    """Gauss-Newton terms in (exp(xi), log f) over the items within the threshold; returns the score."""
    rows = np.empty((16, BLOCK))
    clear_rows(a)
    clear(b)
    items, total = problem.items, 0.0
    n = items.shape[1]
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        total += _rows_of_block(model, items, threshold_sq, soft_sq, start, stop, rows)
        for which in range(2):
            first = 8 * which
            for i in range(7):
                b[i] += dot_rows(rows[first + 1 + i], rows[first], stop - start)
                for j in range(i + 1):
                    a[i, j] += dot_rows(rows[first + 1 + i], rows[first + 1 + j], stop - start)
    for i in range(7):
        for j in range(i):
            a[j, i] = a[i, j]
    return total


def _retract(problem, model, delta, out):
    retract_motion(model, delta, out)
    out[FOCAL] = model[FOCAL] * math.exp(min(max(delta[6], -1.0), 1.0))


implement(
    FocalPoseProblem,
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
