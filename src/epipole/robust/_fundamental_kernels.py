"""Fundamental matrices for the robust loop.

Model: F row by row, |F| = 1; then, once decomposed, U, V and s1 / s0 of its singular value decomposition; then the
sense of its lines and the epipole e2. Residual: Sampson's distance, as for relative poses. The oriented epipolar
constraint (Chum, Werner and Matas, ICPR 2004) stands for "in front": e2 x x2 and F x1 are the same line, and seen
from two sides it must be turned the same way for all matches; others are as far as can be, unless they lie at the
epipole to within the threshold.
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
from epipole.robust._contract_kernels import MODEL_SIZE, implement
from epipole.robust._dominant_plane_kernels import (
    DOMINANT,
    chance_of_agreement,
    find_plane,
    off_plane,
    plane_and_parallax,
)
from epipole.robust._loop_kernels import optimize_locally
from epipole.solvers._linear_kernels import clear, clear_rows, copy_numbers
from epipole.solvers._two_view_kernels import fundamental_seven_point, seven_point_workspace, svd3

RATIO, SENSE, EPIPOLE = 27, 28, 29


class FundamentalProblem(NamedTuple):
    """Matches of order one, rows u1, v1, u2, v2."""

    matches: np.ndarray
    """(4, n)."""


@kernel
def find_epipole(model):
    """The left null vector of F, e2^T F = 0, as the longest cross product of two of its columns, of length one."""
    best = 0.0
    for j in range(3):
        p, q = j, (j + 1) % 3
        x = model[3 + p] * model[6 + q] - model[6 + p] * model[3 + q]
        y = model[6 + p] * model[q] - model[p] * model[6 + q]
        z = model[p] * model[3 + q] - model[3 + p] * model[q]
        size = x * x + y * y + z * z
        if size > best:
            best = size
            model[EPIPOLE], model[EPIPOLE + 1], model[EPIPOLE + 2] = x, y, z
    if not best > 1e-300:
        return False
    inverse = 1.0 / math.sqrt(best)
    for i in range(3):
        model[EPIPOLE + i] *= inverse
    return True


@kernel
def line_sense(model, x1, x2):
    """(e2 x x2) . (F x1)."""
    e0, e1, e2 = model[EPIPOLE], model[EPIPOLE + 1], model[EPIPOLE + 2]
    l0 = model[0] * x1[0] + model[1] * x1[1] + model[2] * x1[2]
    l1 = model[3] * x1[0] + model[4] * x1[1] + model[5] * x1[2]
    l2 = model[6] * x1[0] + model[7] * x1[1] + model[8] * x1[2]
    return (e1 * x2[2] - e2 * x2[1]) * l0 + (e2 * x2[0] - e0 * x2[2]) * l1 + (e0 * x2[1] - e1 * x2[0]) * l2


@kernel(extra_fastmath=REASSOC)
def _score_block(p, m, start, stop, threshold_sq):
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8]
    s0, s1, s2 = p[SENSE] * p[EPIPOLE], p[SENSE] * p[EPIPOLE + 1], p[SENSE] * p[EPIPOLE + 2]
    total = 0.0
    for k in range(start, stop):
        a, b, c, d = m[0, k], m[1, k], m[2, k], m[3, k]
        l0, l1, l2 = f0 * a + f1 * b + f2, f3 * a + f4 * b + f5, f6 * a + f7 * b + f8
        g0, g1 = f0 * c + f3 * d + f6, f1 * c + f4 * d + f7
        e = c * l0 + d * l1 + l2
        r = e * e / (l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300)
        n0, n1, n2 = s1 - s2 * d, s2 * c - s0, s0 * d - s1 * c
        turned = n0 * l0 + n1 * l1 + n2 * l2 < 0.0 and n0 * n0 + n1 * n1 > 4.0 * threshold_sq * s2 * s2
        total += threshold_sq if turned or r > threshold_sq else r
    return total


@kernel
def fundamental_score(model, m, threshold_sq, bail_out):
    """MSAC score of a fundamental matrix; stops once it exceeds bail_out."""
    n, total = m.shape[1], 0.0
    for start in range(0, n, BLOCK):
        total += _score_block(model, m, start, min(start + BLOCK, n), threshold_sq)
        if total > bail_out:
            return total
    return total


@kernel
def fundamental_residuals(p, m, threshold_sq, out):
    """Squared Sampson distances; infinite where the line is turned."""
    s0, s1, s2 = p[SENSE] * p[EPIPOLE], p[SENSE] * p[EPIPOLE + 1], p[SENSE] * p[EPIPOLE + 2]
    for k in range(m.shape[1]):
        a, b, c, d = m[0, k], m[1, k], m[2, k], m[3, k]
        l0, l1, l2 = p[0] * a + p[1] * b + p[2], p[3] * a + p[4] * b + p[5], p[6] * a + p[7] * b + p[8]
        g0, g1 = p[0] * c + p[3] * d + p[6], p[1] * c + p[4] * d + p[7]
        e = c * l0 + d * l1 + l2
        r = e * e / (l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300)
        n0, n1, n2 = s1 - s2 * d, s2 * c - s0, s0 * d - s1 * c
        turned = n0 * l0 + n1 * l1 + n2 * l2 < 0.0 and n0 * n0 + n1 * n1 > 4.0 * threshold_sq * s2 * s2
        out[k] = math.inf if turned else r


@kernel(extra_fastmath=REASSOC)
def fundamental_rows(p, m, start, stop, threshold_sq, soft_sq, rows):
    """Residuals (rows[0]) and their derivatives by the entries of F (rows[1:10]), zero where truncated."""
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8]
    s0, s1, s2 = p[SENSE] * p[EPIPOLE], p[SENSE] * p[EPIPOLE + 1], p[SENSE] * p[EPIPOLE + 2]
    total = 0.0
    for k in range(start, stop):
        a, b, c, d = m[0, k], m[1, k], m[2, k], m[3, k]
        l0, l1, l2 = f0 * a + f1 * b + f2, f3 * a + f4 * b + f5, f6 * a + f7 * b + f8
        g0, g1 = f0 * c + f3 * d + f6, f1 * c + f4 * d + f7
        e = c * l0 + d * l1 + l2
        inverse = 1.0 / (l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300)
        r = e * e * inverse
        n0, n1, n2 = s1 - s2 * d, s2 * c - s0, s0 * d - s1 * c
        turned = n0 * l0 + n1 * l1 + n2 * l2 < 0.0 and n0 * n0 + n1 * n1 > 4.0 * threshold_sq * s2 * s2
        is_out = turned or r > threshold_sq
        total += threshold_sq if is_out else r
        root = 0.0 if is_out else math.sqrt(inverse / (1.0 + r / soft_sq))
        ratio = e * inverse
        u, v, h0, h1 = c - ratio * l0, d - ratio * l1, ratio * g0, ratio * g1
        i = k - start
        rows[0, i] = root * e
        rows[1, i], rows[2, i], rows[3, i] = root * (u * a - h0 * c), root * (u * b - h1 * c), root * u
        rows[4, i], rows[5, i], rows[6, i] = root * (v * a - h0 * d), root * (v * b - h1 * d), root * v
        rows[7, i], rows[8, i], rows[9, i] = root * (a - h0), root * (b - h1), root
    return total


@kernel
def derivatives_of_fundamental(model, d):
    """D (7, 9): F = U diag(1, s, 0) V^T by U exp(u), V exp(v), s + d (Bartoli and Sturm, PAMI 2004)."""
    u, v, ratio = model[9:18], model[18:27], model[RATIO]
    for i in range(3):
        for j in range(3):
            k = 3 * i + j
            u0, u1, u2 = u[3 * i], u[3 * i + 1], u[3 * i + 2]
            v0, v1, v2 = v[3 * j], v[3 * j + 1], v[3 * j + 2]
            # U [e_w]x S V^T and U S [e_w]x^T V^T, written out for S = diag(1, ratio, 0).
            d[0, k] = u2 * ratio * v1
            d[1, k] = -u2 * v0
            d[2, k] = u1 * v0 - u0 * ratio * v1
            d[3, k] = u1 * ratio * v2
            d[4, k] = -u0 * v2
            d[5, k] = u0 * v1 - u1 * ratio * v0
            d[6, k] = u1 * v1


@kernel
def _compose(model):
    """F, of length one, and e2 from U, V and the ratio."""
    norm = 1.0 / math.sqrt(1.0 + model[RATIO] * model[RATIO])
    for i in range(3):
        for j in range(3):
            model[3 * i + j] = norm * (
                model[9 + 3 * i] * model[18 + 3 * j] + model[RATIO] * model[10 + 3 * i] * model[19 + 3 * j]
            )
    along = 0.0
    for i in range(3):
        along += model[EPIPOLE + i] * model[11 + 3 * i]
    for i in range(3):
        model[EPIPOLE + i] = model[11 + 3 * i] if along >= 0.0 else -model[11 + 3 * i]


@kernel(allocates=True)
def decompose(model):
    """Fill U, V and the ratio from F; False if F has rank one."""
    m, u, sv, v = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for i in range(9):
        m[i // 3, i % 3] = model[i]
    if not svd3(m, u, sv, v):
        return False
    for i in range(9):
        model[9 + i], model[18 + i] = u[i // 3, i % 3], v[i // 3, i % 3]
    model[RATIO] = sv[1] / sv[0]
    _compose(model)
    return True


def _sample_size(problem):
    return np.int64(7)


def _num_items(problem):
    return problem.matches.shape[1]


def _workspace(problem):
    return np.empty((7, 3)), np.empty((7, 3)), np.empty((3, 9)), seven_point_workspace()


def _solve_sample(problem, sample, models, work):
    """Solutions whose lines are turned one way for the whole sample."""
    x1, x2, found, solver = work
    gather(problem.matches, sample, x1, x2)
    count = 0
    for k in range(fundamental_seven_point(x1, x2, found, solver)):
        model = models[count]
        copy_numbers(found[k], model)
        if not find_epipole(model):
            continue
        first = line_sense(model, x1[0], x2[0])
        agree = True
        for i in range(1, 7):
            if first * line_sense(model, x1[i], x2[i]) <= 0.0:
                agree = False
                break
        if agree:
            model[SENSE] = 1.0 if first > 0.0 else -1.0
            count += 1
    return count


def _agreeing(problem, model, threshold_sq, start, stop):
    return sampson_agreeing(model, problem.matches, threshold_sq, start, stop)


def _settle(problem, sample, model, settled, work):
    copy_numbers(model, settled[0])
    return 1 if decompose(settled[0]) else 0


def _escape(problem, model, residuals, threshold_sq, state):
    """From a plane that most matches lie on: to the F that the others ask for (see `_dominant_plane_kernels`).

    They alone judge: the plane's matches fit some wrong F better than the right one, whose epipole is not theirs.
    """
    h, other = np.empty(9), np.empty(MODEL_SIZE)
    m = problem.matches
    share, reach_sq = find_plane(model, model[EPIPOLE : EPIPOLE + 3], m, residuals, threshold_sq, state, h)
    if share < DOMINANT:
        return
    off = off_plane(h, m, reach_sq)
    if plane_and_parallax(h, off, threshold_sq, state, other) < 3:
        return
    if not (find_epipole(other) and decompose(other)):
        return
    turned = 0
    one, two = np.ones(3), np.ones(3)
    for k in range(m.shape[1]):
        if residuals[k] < threshold_sq:
            one[0], one[1], two[0], two[1] = m[0, k], m[1, k], m[2, k], m[3, k]
            turned += 1 if line_sense(other, one, two) < 0.0 else -1
    other[SENSE] = -1.0 if turned > 0 else 1.0
    optimize_locally(problem, other, threshold_sq)
    before = fundamental_score(model, off, threshold_sq, math.inf)
    # Two matches fit whatever epipole they fix, and another joins them by chance.
    if fundamental_score(other, off, threshold_sq, math.inf) + 3.0 * threshold_sq < before:
        copy_numbers(other, model)


@kernel(allocates=True)
def parallax_support(model, m, threshold_sq, seed):
    """(share of the inliers on a plane, matches off it, those of them that agree with F, chance that one does)."""
    residuals, h, state = np.empty(m.shape[1]), np.empty(9), np.empty(1, np.uint64)
    state[0] = seed
    fundamental_residuals(model, m, threshold_sq, residuals)
    share, reach_sq = find_plane(model, model[EPIPOLE : EPIPOLE + 3], m, residuals, threshold_sq, state, h)
    if share < DOMINANT:
        return share, 0, 0, 1.0
    off = off_plane(h, m, reach_sq)
    agreed = sampson_agreeing(model, off, threshold_sq, 0, off.shape[1])
    return share, off.shape[1], agreed, chance_of_agreement(model, m, threshold_sq)


def _score(problem, model, threshold_sq, bail_out):
    return fundamental_score(model, problem.matches, threshold_sq, bail_out)


def _residuals_sq(problem, model, threshold_sq, out):
    fundamental_residuals(model, problem.matches, threshold_sq, out)


def _residual_size(problem):
    return np.int64(1)


def _near(problem, model, threshold_sq):
    residuals = np.empty(problem.matches.shape[1])
    fundamental_residuals(model, problem.matches, threshold_sq, residuals)
    return FundamentalProblem(columns_within(problem.matches, residuals, threshold_sq))


def _linearize(problem, model, threshold_sq, soft_sq, a, b):
    """Gauss-Newton terms in the seven parameters of F over the matches within the threshold; returns the score."""
    d, rows, jac = np.empty((7, 9)), np.empty((10, BLOCK)), np.empty((7, BLOCK))
    clear_rows(a)
    clear(b)
    derivatives_of_fundamental(model, d)
    # F is kept at length one: d F / d theta of F / |F|; the part along F itself moves no residual.
    matches, total = problem.matches, 0.0
    n = matches.shape[1]
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        total += fundamental_rows(model, matches, start, stop, threshold_sq, soft_sq, rows)
        add_normal_equations(d, rows, jac, stop - start, a, b)
    scale = 1.0 / math.sqrt(1.0 + model[RATIO] * model[RATIO])
    for i in range(7):
        b[i] *= scale
        for j in range(i + 1):
            a[i, j] *= scale * scale
            a[j, i] = a[i, j]
    return total


def _retract(problem, model, delta, out):
    transposed, turned, back = np.empty(9), np.empty(9), np.empty(3)
    for which in range(2):
        base = 9 + 9 * which
        for i in range(3):
            back[i] = -delta[3 * which + i]
            for j in range(3):
                transposed[3 * j + i] = model[base + 3 * i + j]
        # U exp(u) = (exp(-u) U^T)^T
        rotate_left(back, transposed, turned)
        for i in range(3):
            for j in range(3):
                out[base + 3 * i + j] = turned[3 * j + i]
    out[RATIO] = max(model[RATIO] + delta[6], 0.0)
    _compose(out)


implement(
    FundamentalProblem,
    sample_size=_sample_size,
    num_items=_num_items,
    degrees_of_freedom=_sample_size,
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
    escape=_escape,
)
