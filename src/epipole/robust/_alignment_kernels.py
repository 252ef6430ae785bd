"""Rigid motions and similarities between two point sets, for the robust loop.

Model: R row by row, t, s. Residual: s R x + t - y, three numbers.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel
from epipole.robust._item_kernels import rotate_left
from epipole.robust._problem_kernels import Items, RobustProblem
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
    """Gauss-Newton terms in (t, rotation from the left, log s) over items within the threshold; returns the score."""
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


class PointsProblem(RobustProblem):
    """A similarity with the residual s R x + t - y, three numbers."""

    __slots__ = ()

    def residual_size(self):
        return np.int64(3)

    def error_sq(self, model, threshold_sq, k):
        p, m = model, self.items
        a, b, c = m[0, k], m[1, k], m[2, k]
        u = p[SCALE] * (p[0] * a + p[1] * b + p[2] * c) + p[9] - m[3, k]
        v = p[SCALE] * (p[3] * a + p[4] * b + p[5] * c) + p[10] - m[4, k]
        w = p[SCALE] * (p[6] * a + p[7] * b + p[8] * c) + p[11] - m[5, k]
        return u * u + v * v + w * w


class AlignmentProblem(PointsProblem, MatchedPoints):
    """The motion, or similarity, that maps x to y."""

    __slots__ = ()

    def sample_size(self):
        return np.int64(3)

    def degrees_of_freedom(self):
        return self.freedom

    def workspace(self):
        return np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))

    def solve_sample(self, sample, models, work):
        x, y, a, b = work
        for k in range(3):
            for i in range(3):
                x[k, i], y[k, i] = self.items[i, sample[k]], self.items[3 + i, sample[k]]
        found = align_three_points(x, y, self.freedom == 7, a, b, models[0])
        return np.int64(1) if found else np.int64(0)

    def linearize(self, model, threshold_sq, soft_sq, a, b):
        return alignment_normal_equations(model, self.items, threshold_sq, soft_sq, self.freedom, a, b)

    def retract(self, model, delta, out):
        _retract_alignment(model, delta, self.freedom, out)

    def with_items(self, items):
        return AlignmentProblem(items, self.freedom)


@kernel
def _step_in_space(delta, full):
    """Expand a step (t, heading, log s) to (t, rotation, log s)."""
    full[0], full[1], full[2], full[3], full[4] = delta[0], delta[1], delta[2], 0.0, 0.0
    full[5], full[6] = delta[3], delta[4]


@kernel
def _rotation_about_z(x, y, model):
    """The similarity about the z axis that maps the points x (2, 3) to y; False if they coincide seen from above.

    With horizontal coordinates as complex numbers, s e^(i heading) = (y1 - y0) / (x1 - x0).
    """
    p, q, u, v = x[1, 0] - x[0, 0], x[1, 1] - x[0, 1], y[1, 0] - y[0, 0], y[1, 1] - y[0, 1]
    size = p * p + q * q
    scale = math.sqrt((u * u + v * v) / size)
    if not (size > 0.0 and 0.0 < scale < math.inf):
        return False
    cos, sin = (p * u + q * v) / (size * scale), (p * v - q * u) / (size * scale)
    for i in range(9):
        model[i] = 0.0
    model[0], model[1], model[3], model[4], model[8], model[SCALE] = cos, -sin, sin, cos, 1.0, scale
    for i in range(3):
        rotated = model[3 * i] * (x[0, 0] + x[1, 0]) + model[3 * i + 1] * (x[0, 1] + x[1, 1])
        rotated += model[3 * i + 2] * (x[0, 2] + x[1, 2])
        model[9 + i] = 0.5 * (y[0, i] + y[1, i] - scale * rotated)
    return True


class UprightAlignmentProblem(PointsProblem, Items):
    """The similarity that keeps the z axis and maps x to y; rows x (3), y (3). Steps are (t, heading, log s)."""

    __slots__ = ()

    def sample_size(self):
        return np.int64(2)

    def degrees_of_freedom(self):
        return np.int64(5)

    def workspace(self):
        return np.empty((2, 3)), np.empty((2, 3))

    def solve_sample(self, sample, models, work):
        x, y = work
        for k in range(2):
            for i in range(3):
                x[k, i], y[k, i] = self.items[i, sample[k]], self.items[3 + i, sample[k]]
        return np.int64(1) if _rotation_about_z(x, y, models[0]) else np.int64(0)

    def linearize(self, model, threshold_sq, soft_sq, a, b):
        full_a, full_b = np.empty((7, 7)), np.empty(7)
        total = alignment_normal_equations(
            model, self.items, threshold_sq, soft_sq, np.int64(7), full_a, full_b
        )
        for i in range(5):
            row = i if i < 3 else i + 2
            b[i] = full_b[row]
            for j in range(5):
                a[i, j] = full_a[row, j if j < 3 else j + 2]
        return total

    def retract(self, model, delta, out):
        full = np.empty(7)
        _step_in_space(delta, full)
        _retract_alignment(model, full, np.int64(7), out)

    def with_items(self, items):
        return UprightAlignmentProblem(items)
