"""Rigid motions and similarities between two sets of points for the robust loop.

Model: R row by row, t, s. Residual: s R x + t - y, three numbers.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel
from epipole.robust._item_kernels import rotate_left
from epipole.robust._problem_kernels import RobustProblem
from epipole.solvers._alignment_kernels import SCALE as SCALE
from epipole.solvers._alignment_kernels import align_three_points
from epipole.solvers._linear_kernels import clear, clear_rows


class MatchedPoints(NamedTuple):
    """Points in two frames."""

    items: np.ndarray
    """(6, n): rows x (3), y (3)."""
    freedom: int
    """7 with scale, 6 without."""


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


class AlignmentProblem(RobustProblem, MatchedPoints):
    """The motion, or similarity, that takes x to y."""

    __slots__ = ()

    def sample_size(self):
        return np.int64(3)

    def degrees_of_freedom(self):
        return self.freedom

    def residual_size(self):
        return np.int64(3)

    def workspace(self):
        return np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))

    def solve_sample(self, sample, models, work):
        x, y, a, b = work
        for k in range(3):
            for i in range(3):
                x[k, i], y[k, i] = self.items[i, sample[k]], self.items[3 + i, sample[k]]
        found = align_three_points(x, y, self.freedom == 7, a, b, models[0])
        return np.int64(1) if found else np.int64(0)

    def error_sq(self, model, threshold_sq, k):
        p, m = model, self.items
        a, b, c = m[0, k], m[1, k], m[2, k]
        u = p[SCALE] * (p[0] * a + p[1] * b + p[2] * c) + p[9] - m[3, k]
        v = p[SCALE] * (p[3] * a + p[4] * b + p[5] * c) + p[10] - m[4, k]
        w = p[SCALE] * (p[6] * a + p[7] * b + p[8] * c) + p[11] - m[5, k]
        return u * u + v * v + w * w

    def linearize(self, model, threshold_sq, soft_sq, a, b):
        return alignment_normal_equations(model, self.items, threshold_sq, soft_sq, self.freedom, a, b)

    def retract(self, model, delta, out):
        _retract_alignment(model, delta, self.freedom, out)

    def with_items(self, items):
        return AlignmentProblem(items, self.freedom)
