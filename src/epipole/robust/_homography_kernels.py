"""Homographies for the robust loop.

Model: H row by row, |H| = 1, with positive third coordinates for the points in front. Residual: with e = H x1 - x2 in
image 2 and its derivative J by x1, noise of one size in both pictures gives e the covariance I + J J^T. Sampson's distance
(HZ section 4.2.6) is e^T (I + J J^T)^-1 e; twice that is used, which is |e|^2 where H keeps lengths, so that a threshold
means pixels of transfer. Points that H moves through infinity are as far as can be.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel
from epipole.robust._block_kernels import BLOCK, REASSOC, columns_within, dot_rows, gather
from epipole.robust._contract_kernels import implement
from epipole.solvers._linear_kernels import clear, clear_rows, copy_numbers
from epipole.solvers._two_view_kernels import homography_four_point


class HomographyProblem(NamedTuple):
    """Matches of order one, rows u1, v1, u2, v2."""

    matches: np.ndarray
    """(4, n)."""


@kernel(extra_fastmath=REASSOC)
def symmetric_agreeing(h, m, threshold_sq, start, stop):
    """Number of matches start..stop with a squared residual below the threshold."""
    h0, h1, h2, h3, h4, h5, h6, h7, h8 = h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]
    count = 0
    for k in range(start, stop):
        a, b = m[0, k], m[1, k]
        w = h6 * a + h7 * b + h8
        inverse = 1.0 / (w if w > 0.0 else 1.0)
        u, v = (h0 * a + h1 * b + h2) * inverse, (h3 * a + h4 * b + h5) * inverse
        du, dv = u - m[2, k], v - m[3, k]
        j0, j1 = (h0 - u * h6) * inverse, (h1 - u * h7) * inverse
        j2, j3 = (h3 - v * h6) * inverse, (h4 - v * h7) * inverse
        c0, c1, c2 = (
            0.5 + 0.5 * (j0 * j0 + j1 * j1),
            0.5 * (j0 * j2 + j1 * j3),
            0.5 + 0.5 * (j2 * j2 + j3 * j3),
        )
        r = (c2 * du * du - 2.0 * c1 * du * dv + c0 * dv * dv) / (c0 * c2 - c1 * c1)
        count += 1 if w > 0.0 and r < threshold_sq else 0
    return count


@kernel(extra_fastmath=REASSOC)
def _score_block(h, m, threshold_sq, start, stop):
    h0, h1, h2, h3, h4, h5, h6, h7, h8 = h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]
    total = 0.0
    for k in range(start, stop):
        a, b = m[0, k], m[1, k]
        w = h6 * a + h7 * b + h8
        inverse = 1.0 / (w if w > 0.0 else 1.0)
        u, v = (h0 * a + h1 * b + h2) * inverse, (h3 * a + h4 * b + h5) * inverse
        du, dv = u - m[2, k], v - m[3, k]
        j0, j1 = (h0 - u * h6) * inverse, (h1 - u * h7) * inverse
        j2, j3 = (h3 - v * h6) * inverse, (h4 - v * h7) * inverse
        c0, c1, c2 = (
            0.5 + 0.5 * (j0 * j0 + j1 * j1),
            0.5 * (j0 * j2 + j1 * j3),
            0.5 + 0.5 * (j2 * j2 + j3 * j3),
        )
        r = (c2 * du * du - 2.0 * c1 * du * dv + c0 * dv * dv) / (c0 * c2 - c1 * c1)
        total += r if w > 0.0 and r < threshold_sq else threshold_sq
    return total


@kernel
def symmetric_score(h, m, threshold_sq, bail_out):
    """MSAC score of a homography; stops once it exceeds bail_out."""
    n, total = m.shape[1], 0.0
    for start in range(0, n, BLOCK):
        total += _score_block(h, m, threshold_sq, start, min(start + BLOCK, n))
        if total > bail_out:
            return total
    return total


@kernel
def symmetric_residuals(h, m, out):
    """Squared residual of every match; infinite beyond infinity."""
    for k in range(m.shape[1]):
        a, b = m[0, k], m[1, k]
        w = h[6] * a + h[7] * b + h[8]
        if not w > 0.0:
            out[k] = math.inf
            continue
        u, v = (h[0] * a + h[1] * b + h[2]) / w, (h[3] * a + h[4] * b + h[5]) / w
        du, dv = u - m[2, k], v - m[3, k]
        j0, j1, j2, j3 = (
            (h[0] - u * h[6]) / w,
            (h[1] - u * h[7]) / w,
            (h[3] - v * h[6]) / w,
            (h[4] - v * h[7]) / w,
        )
        c0, c1, c2 = (
            0.5 + 0.5 * (j0 * j0 + j1 * j1),
            0.5 * (j0 * j2 + j1 * j3),
            0.5 + 0.5 * (j2 * j2 + j3 * j3),
        )
        out[k] = (c2 * du * du - 2.0 * c1 * du * dv + c0 * dv * dv) / (c0 * c2 - c1 * c1)


@kernel(extra_fastmath=REASSOC)
def _rows_of_block(h, m, threshold_sq, soft_sq, start, stop, rows):
    """Whitened residuals (rows 0, 10) and derivatives by the entries of H (1:10, 11:20), zero where truncated.

    du/dh = (p, 0, -u p), dv/dh = (0, p, -v p) with p = x1 / w; both are multiplied by the inverse Cholesky factor of C.
    """
    h0, h1, h2, h3, h4, h5, h6, h7, h8 = h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]
    total = 0.0
    for k in range(start, stop):
        a, b = m[0, k], m[1, k]
        w = h6 * a + h7 * b + h8
        inverse = 1.0 / (w if w > 0.0 else 1.0)
        u, v = (h0 * a + h1 * b + h2) * inverse, (h3 * a + h4 * b + h5) * inverse
        du, dv = u - m[2, k], v - m[3, k]
        j0, j1 = (h0 - u * h6) * inverse, (h1 - u * h7) * inverse
        j2, j3 = (h3 - v * h6) * inverse, (h4 - v * h7) * inverse
        c0, c1, c2 = (
            0.5 + 0.5 * (j0 * j0 + j1 * j1),
            0.5 * (j0 * j2 + j1 * j3),
            0.5 + 0.5 * (j2 * j2 + j3 * j3),
        )
        f0 = 1.0 / math.sqrt(c0)
        f2 = 1.0 / math.sqrt(c2 - c1 * c1 / c0)
        f1 = -c1 / c0 * f2
        ru, rv = f0 * du, f1 * du + f2 * dv
        r = ru * ru + rv * rv
        is_in = w > 0.0 and r < threshold_sq
        total += r if is_in else threshold_sq
        keep, i = (math.sqrt(1.0 / (1.0 + r / soft_sq)) if is_in else 0.0), k - start
        x, y, z = keep * a * inverse, keep * b * inverse, keep * inverse
        g0, g1, g2, g3 = f0, f1, f2, f1 * u + f2 * v
        rows[0, i], rows[10, i] = keep * ru, keep * rv
        rows[1, i], rows[2, i], rows[3, i] = g0 * x, g0 * y, g0 * z
        rows[4, i], rows[5, i], rows[6, i] = 0.0, 0.0, 0.0
        rows[7, i], rows[8, i], rows[9, i] = -g0 * u * x, -g0 * u * y, -g0 * u * z
        rows[11, i], rows[12, i], rows[13, i] = g1 * x, g1 * y, g1 * z
        rows[14, i], rows[15, i], rows[16, i] = g2 * x, g2 * y, g2 * z
        rows[17, i], rows[18, i], rows[19, i] = -g3 * x, -g3 * y, -g3 * z
    return total


@kernel(allocates=True)
def symmetric_normal_equations(h, m, threshold_sq, soft_sq, a, b):
    """Gauss-Newton terms in the nine entries of H, its length held; returns the score."""
    rows = np.empty((20, BLOCK))
    clear_rows(a)
    clear(b)
    n, total = m.shape[1], 0.0
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        total += _rows_of_block(h, m, threshold_sq, soft_sq, start, stop, rows)
        for which in range(2):
            first = 10 * which
            for i in range(9):
                b[i] += dot_rows(rows[first + 1 + i], rows[first], stop - start)
                for j in range(i + 1):
                    a[i, j] += dot_rows(rows[first + 1 + i], rows[first + 1 + j], stop - start)
    # One parameter too many: the scale of H changes nothing; a penalty on it leaves the other steps as they are.
    weight = (a[0, 0] + a[4, 4] + a[8, 8]) / 3.0
    for i in range(9):
        for j in range(i + 1):
            a[i, j] += weight * h[i] * h[j]
            a[j, i] = a[i, j]
    return total


@kernel
def retract_matrix(model, delta, out):
    """Model + delta, of length one."""
    norm = 0.0
    for i in range(9):
        out[i] = model[i] + delta[i]
        norm += out[i] * out[i]
    norm = 1.0 / math.sqrt(norm)
    for i in range(9):
        out[i] *= norm


def _sample_size(problem):
    return np.int64(4)


def _num_items(problem):
    return problem.matches.shape[1]


def _degrees_of_freedom(problem):
    return np.int64(9)


def _workspace(problem):
    return np.empty((4, 3)), np.empty((4, 3))


def _solve_sample(problem, sample, models, work):
    x1, x2 = work
    gather(problem.matches, sample, x1, x2)
    if not homography_four_point(x1, x2, models[0]):
        return 0
    h = models[0]
    if h[6] * x1[0, 0] + h[7] * x1[0, 1] + h[8] < 0.0:
        for i in range(9):
            h[i] = -h[i]
    return 1


def _agreeing(problem, model, threshold_sq, start, stop):
    return symmetric_agreeing(model, problem.matches, threshold_sq, start, stop)


def _settle(problem, sample, model, settled, work):
    copy_numbers(model, settled[0])
    return 1


def _score(problem, model, threshold_sq, bail_out):
    return symmetric_score(model, problem.matches, threshold_sq, bail_out)


def _residuals_sq(problem, model, threshold_sq, out):
    symmetric_residuals(model, problem.matches, out)


def _residual_size(problem):
    return np.int64(2)


def _near(problem, model, threshold_sq):
    residuals = np.empty(problem.matches.shape[1])
    symmetric_residuals(model, problem.matches, residuals)
    return HomographyProblem(columns_within(problem.matches, residuals, threshold_sq))


def _linearize(problem, model, threshold_sq, soft_sq, a, b):
    return symmetric_normal_equations(model, problem.matches, threshold_sq, soft_sq, a, b)


def _retract(problem, model, delta, out):
    retract_matrix(model, delta, out)


implement(
    HomographyProblem,
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
