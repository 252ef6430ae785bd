"""Relative pose of calibrated cameras, for the robust loop.

Model: motion (R row by row, t), |t| = 1, then E. Residual: Sampson's first-order distance (1982; HZ eq. 11.9),

    r = e / sqrt(m), e = x2^T E x1, m = |(E x1)_12|^2 + |(E^T x2)_12|^2, E = [t]x R,

for matches in front of both cameras; infinite for others. Rays that are parallel within the threshold count as in front, as
far points have depths of either sign.
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
from epipole.robust._problem_kernels import Items, MatrixProblem, compile_inside_kernels
from epipole.solvers._five_point_kernels import essential_five_point, five_point_workspace
from epipole.solvers._linear_kernels import copy_numbers
from epipole.solvers._two_view_kernels import essential_from_motion, motions_from_essential

MATRIX = 12  # start of E in a model


@kernel(fuse=True)
def diverge(r, t, one, two, slack):
    """Whether the rays of a match diverge by more than `slack`: then they have no point in front of both cameras.

    Compares their depths, times a positive determinant (see `is_in_front`), with the lengths of the rays.
    """
    x = r[0] * one[0] + r[1] * one[1] + r[2] * one[2]
    y = r[3] * one[0] + r[4] * one[1] + r[5] * one[2]
    z = r[6] * one[0] + r[7] * one[1] + r[8] * one[2]
    xx, yy = x * x + y * y + z * z, two[0] * two[0] + two[1] * two[1] + two[2] * two[2]
    xy = x * two[0] + y * two[1] + z * two[2]
    xt, yt = x * t[0] + y * t[1] + z * t[2], two[0] * t[0] + two[1] * t[1] + two[2] * t[2]
    least = -slack * xx * yy
    return (xy * yt - yy * xt < least) | (xx * yt - xy * xt < least)


@kernel(extra_fastmath=REASSOC)
def _score_block(model, m, threshold_sq, start, stop):
    """MSAC score of matches start..stop, with shared values loaded once (a third faster)."""
    r, t, f = nine(model, 0), (model[9], model[10], model[11]), nine(model, 12)
    slack, total = math.sqrt(threshold_sq), 0.0
    for k in range(start, stop):
        e, s, _, _ = sampson(f, m, k)
        error = e * e / s
        one, two = (m[0, k], m[1, k], 1.0), (m[2, k], m[3, k], 1.0)
        total += threshold_sq if diverge(r, t, one, two, slack) or error > threshold_sq else error
    return total


@kernel
def _rows_of_block(model, m, threshold_sq, soft_sq, start, stop, rows):
    """Residuals (rows[0]) and their derivatives by E (rows[1:10]) of matches start..stop, zero where truncated."""
    r, t, f = nine(model, 0), (model[9], model[10], model[11]), nine(model, 12)
    slack, errors = math.sqrt(threshold_sq), rows[len(rows) - 1]
    for k in range(start, stop):
        e, s, line, back = sampson(f, m, k)
        inverse = 1.0 / s
        error = e * e * inverse
        one, two = (m[0, k], m[1, k], 1.0), (m[2, k], m[3, k], 1.0)
        is_out = diverge(r, t, one, two, slack) or error > threshold_sq
        root = 0.0 if is_out else math.sqrt(inverse / (1.0 + error / soft_sq))
        row, i = sampson_row(m, k, e, inverse, root, line, back), k - start
        errors[i] = threshold_sq if is_out else error
        rows[0, i] = row[0]
        rows[1, i], rows[2, i], rows[3, i] = row[1]
        rows[4, i], rows[5, i], rows[6, i] = row[2]
        rows[7, i], rows[8, i], rows[9, i] = row[3]


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


class MotionProblem(MatrixProblem):
    """Relative pose of calibrated cameras, for any layout of the matches."""

    __slots__ = ()

    def gather_rays(self, sample, y1, y2):
        """Rays of the sampled matches, one per row."""

    def sample_size(self):
        return np.int64(5)

    def degrees_of_freedom(self):
        return np.int64(5)

    def workspace(self):
        return (
            np.empty((5, 3)),
            np.empty((5, 3)),
            np.empty((10, 9)),
            np.empty((4, 12)),
            five_point_workspace(),
        )

    def solve_sample(self, sample, models, work):
        y1, y2, essentials, _, solver = work
        self.gather_rays(sample, y1, y2)
        count = essential_five_point(y1, y2, essentials, solver)
        for k in range(count):
            for i in range(9):
                models[k, MATRIX + i] = essentials[k, i]
        return count

    def refine(self, sample, model, refined, work):
        # Of the four motions of E, keep those that put the sample in front.
        y1, y2, _, motions, _ = work
        self.gather_rays(sample, y1, y2)
        count = motions_from_essential(model[MATRIX : MATRIX + 9], y1, y2, motions)
        for c in range(count):
            copy_numbers(motions[c], refined[c])
            essential_from_motion(refined[c], refined[c, MATRIX : MATRIX + 9])
        return count

    def derivatives(self, model, d):
        derivatives_of_essential(model, d)

    def retract(self, model, delta, out):
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
        essential_from_motion(out, out[MATRIX : MATRIX + 9])


compile_inside_kernels(MotionProblem, "gather_rays")


class PlaneMotionProblem(MotionProblem):
    """Matches on the planes z = 1, rows u1, v1, u2, v2."""

    __slots__ = ()

    def gather_rays(self, sample, y1, y2):
        gather(self.items, sample, y1, y2)

    def agreeing(self, model, threshold_sq, start, stop):
        return sampson_agreeing(model[MATRIX : MATRIX + 9], self.items, threshold_sq, start, stop)

    def error_sq(self, model, threshold_sq, k):
        m = self.items
        e, s, _, _ = sampson(nine(model, 12), m, k)
        one, two = (m[0, k], m[1, k], 1.0), (m[2, k], m[3, k], 1.0)
        t = (model[9], model[10], model[11])
        return math.inf if diverge(nine(model, 0), t, one, two, math.sqrt(threshold_sq)) else e * e / s

    def score_block(self, model, threshold_sq, start, stop):
        return _score_block(model, self.items, threshold_sq, start, stop)

    def rows_of_block(self, model, threshold_sq, soft_sq, start, stop, rows):
        return _rows_of_block(model, self.items, threshold_sq, soft_sq, start, stop, rows)


class RelativePoseProblem(PlaneMotionProblem, Items):
    """Relative pose from five points."""

    __slots__ = ()

    def with_items(self, items):
        return RelativePoseProblem(items)
