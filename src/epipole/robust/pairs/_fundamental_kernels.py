"""Fundamental matrices, for the robust loop.

Model: F row by row, |F| = 1; then, once decomposed, U, V and s1 / s0 of its singular value decomposition; then the sign of
its lines and the epipole e2. Residual: the Sampson distance, as for relative poses. Instead of "in front" there is the
oriented epipolar constraint (Chum, Werner and Matas, ICPR 2004): e2 x x2 and F x1 are the same line up to sign, and the sign
must be the same for all matches. Others have infinite error, unless they lie at the epipole within the threshold.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.robust._item_kernels import (
    REASSOC,
    gather,
    nine,
    rotate_left,
    sampson,
    sampson_agreeing,
    sampson_row,
)
from epipole.robust._loop_kernels import optimize_locally
from epipole.robust._problem_kernels import MODEL_SIZE, Items, MatrixProblem
from epipole.robust.pairs._dominant_plane_kernels import (
    DOMINANT,
    chance_of_agreement,
    find_plane,
    off_plane,
    plane_and_parallax,
)
from epipole.solvers._linear_kernels import copy_numbers
from epipole.solvers._two_view_kernels import fundamental_seven_point, seven_point_workspace, svd3

RATIO, SENSE, EPIPOLE = 27, 28, 29


@kernel
def find_epipole(model):
    """The left null vector of F, e2^T F = 0: the longest cross product of two columns, normalized."""
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


@kernel(fuse=True)
def signed_epipole(model):
    """The epipole e2 times the sign of the lines, as a tuple."""
    sense = model[SENSE]
    return sense * model[EPIPOLE], sense * model[EPIPOLE + 1], sense * model[EPIPOLE + 2]


@kernel(fuse=True)
def is_behind(epipole, m, k, line, threshold_sq):
    """Whether match k has the opposite line orientation to the sample, and is farther from e2 than the threshold.

    `epipole` is e2 times the sample's sign, a tuple.
    """
    s0, s1, s2 = epipole
    c, d = m[2, k], m[3, k]
    n0, n1, n2 = s1 - s2 * d, s2 * c - s0, s0 * d - s1 * c
    behind = n0 * line[0] + n1 * line[1] + n2 * line[2] < 0.0
    return behind and n0 * n0 + n1 * n1 > 4.0 * threshold_sq * s2 * s2


@kernel(extra_fastmath=REASSOC)
def _score_block(model, m, threshold_sq, start, stop):
    """MSAC score of matches start..stop, with shared values loaded once (a third faster)."""
    f, epipole, total = nine(model, 0), signed_epipole(model), 0.0
    for k in range(start, stop):
        e, s, line, _ = sampson(f, m, k)
        r = e * e / s
        total += threshold_sq if is_behind(epipole, m, k, line, threshold_sq) or r > threshold_sq else r
    return total


@kernel
def _rows_of_block(model, m, threshold_sq, soft_sq, start, stop, rows):
    """Residuals (rows[0]) and their derivatives by the entries of F (rows[1:10]), zero where truncated."""
    f, epipole, error = nine(model, 0), signed_epipole(model), rows[len(rows) - 1]
    for k in range(start, stop):
        e, s, line, back = sampson(f, m, k)
        inverse = 1.0 / s
        r = e * e * inverse
        is_out = is_behind(epipole, m, k, line, threshold_sq) or r > threshold_sq
        root = 0.0 if is_out else math.sqrt(inverse / (1.0 + r / soft_sq))
        row, i = sampson_row(m, k, e, inverse, root, line, back), k - start
        error[i] = threshold_sq if is_out else r
        rows[0, i] = row[0]
        rows[1, i], rows[2, i], rows[3, i] = row[1]
        rows[4, i], rows[5, i], rows[6, i] = row[2]
        rows[7, i], rows[8, i], rows[9, i] = row[3]


@kernel
def derivatives_of_fundamental(model, d):
    """D (7, 9): F = U diag(1, s, 0) V^T by U exp(u), V exp(v), s + d (Bartoli and Sturm, PAMI 2004).

    For F of unit length; the component along F itself changes no residual and is kept.
    """
    u, v, ratio = model[9:18], model[18:27], model[RATIO]
    scale = 1.0 / math.sqrt(1.0 + ratio * ratio)
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
            for c in range(7):
                d[c, k] *= scale


@kernel
def _compose(model):
    """F, of unit length, and e2 from U, V and the ratio."""
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


class EpipolarProblem(MatrixProblem):
    """Residuals of a fundamental matrix, for any parameters; normalized matches, rows u1, v1, u2, v2."""

    __slots__ = ()

    def agreeing(self, model, threshold_sq, start, stop):
        return sampson_agreeing(model, self.items, threshold_sq, start, stop)

    def error_sq(self, model, threshold_sq, k):
        e, s, line, _ = sampson(nine(model, 0), self.items, k)
        return math.inf if is_behind(signed_epipole(model), self.items, k, line, threshold_sq) else e * e / s

    def score_block(self, model, threshold_sq, start, stop):
        return _score_block(model, self.items, threshold_sq, start, stop)

    def rows_of_block(self, model, threshold_sq, soft_sq, start, stop, rows):
        return _rows_of_block(model, self.items, threshold_sq, soft_sq, start, stop, rows)


class FundamentalProblem(EpipolarProblem, Items):
    """Fundamental matrix from seven points."""

    __slots__ = ()

    def sample_size(self):
        return np.int64(7)

    def degrees_of_freedom(self):
        return np.int64(7)

    def workspace(self):
        return np.empty((7, 3)), np.empty((7, 3)), np.empty((3, 9)), seven_point_workspace()

    def solve_sample(self, sample, models, work):
        # Keep solutions with the same line orientation for the full sample.
        x1, x2, found, solver = work
        gather(self.items, sample, x1, x2)
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

    def refine(self, sample, model, refined, work):
        copy_numbers(model, refined[0])
        return np.int64(1) if decompose(refined[0]) else np.int64(0)

    def derivatives(self, model, d):
        derivatives_of_fundamental(model, d)

    def retract(self, model, delta, out):
        transposed, behind, back = np.empty(9), np.empty(9), np.empty(3)
        for which in range(2):
            base = 9 + 9 * which
            for i in range(3):
                back[i] = -delta[3 * which + i]
                for j in range(3):
                    transposed[3 * j + i] = model[base + 3 * i + j]
            # U exp(u) = (exp(-u) U^T)^T
            rotate_left(back, transposed, behind)
            for i in range(3):
                for j in range(3):
                    out[base + 3 * i + j] = behind[3 * j + i]
        out[RATIO] = max(model[RATIO] + delta[6], 0.0)
        _compose(out)

    def with_items(self, items):
        return FundamentalProblem(items)

    def escape(self, model, residuals, threshold_sq, state):
        """If a plane contains most matches, switch to the F that the others support (see `_dominant_plane_kernels`).

        Only the others are scored: the plane's matches may fit a wrong F better, as they do not determine the epipole.
        """
        h, other = np.empty(9), np.empty(MODEL_SIZE)
        m = self.items
        fraction, reach_sq = find_plane(
            model, model[EPIPOLE : EPIPOLE + 3], m, residuals, threshold_sq, state, h
        )
        if fraction < DOMINANT:
            return
        off = off_plane(h, m, reach_sq)
        if plane_and_parallax(h, off, threshold_sq, state, other) < 3:
            return
        if not (find_epipole(other) and decompose(other)):
            return
        behind = 0
        one, two = np.ones(3), np.ones(3)
        for k in range(m.shape[1]):
            if residuals[k] < threshold_sq:
                one[0], one[1], two[0], two[1] = m[0, k], m[1, k], m[2, k], m[3, k]
                behind += 1 if line_sense(other, one, two) < 0.0 else -1
        other[SENSE] = -1.0 if behind > 0 else 1.0
        optimize_locally(self, other, threshold_sq)
        others = FundamentalProblem(off)
        before = others.score(model, threshold_sq, math.inf)
        # Two matches fit the epipole that they define, and a third may agree by chance.
        if others.score(other, threshold_sq, math.inf) + 3.0 * threshold_sq < before:
            copy_numbers(other, model)


@kernel(allocates=True)
def parallax_support(model, m, threshold_sq, seed):
    """(fraction of inliers on a plane, matches off it, those that agree with F, probability of chance agreement)."""
    residuals, h, state = np.empty(m.shape[1]), np.empty(9), np.empty(1, np.uint64)
    state[0] = seed
    FundamentalProblem(m).residuals_sq(model, threshold_sq, residuals)
    fraction, reach_sq = find_plane(model, model[EPIPOLE : EPIPOLE + 3], m, residuals, threshold_sq, state, h)
    if fraction < DOMINANT:
        return fraction, 0, 0, 1.0
    off = off_plane(h, m, reach_sq)
    agreed = sampson_agreeing(model, off, threshold_sq, 0, off.shape[1])
    return fraction, off.shape[1], agreed, chance_of_agreement(model, m, threshold_sq)
