"""Homographies, for the robust loop.

Model: H row by row, |H| = 1, with positive third coordinates for points in front. Residual: with e = H x1 - x2 in image 2
and its derivative J by x1, equal noise in both images gives e the covariance I + J J^T. The squared Sampson distance (HZ
section 4.2.6) is e^T (I + J J^T)^-1 e; twice that is used, which is |e|^2 if H preserves lengths, so that a threshold is in
pixels of transfer error. Points that H maps through infinity have infinite error.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.robust._item_kernels import gather, nine
from epipole.robust._problem_kernels import Items, RobustProblem
from epipole.solvers._two_view_kernels import homography_four_point


@kernel(fuse=True)
def transfer(h, m, k):
    """(w, 1 / w, H x1, e, C) of match k: C = (1 + J J^T) / 2 as (c00, c01, c11); h is a tuple, H row by row."""
    a, b = m[0, k], m[1, k]
    w = h[6] * a + h[7] * b + h[8]
    inverse = 1.0 / (w if w > 0.0 else 1.0)
    u, v = (h[0] * a + h[1] * b + h[2]) * inverse, (h[3] * a + h[4] * b + h[5]) * inverse
    j0, j1 = (h[0] - u * h[6]) * inverse, (h[1] - u * h[7]) * inverse
    j2, j3 = (h[3] - v * h[6]) * inverse, (h[4] - v * h[7]) * inverse
    covariance = (
        0.5 + 0.5 * (j0 * j0 + j1 * j1),
        0.5 * (j0 * j2 + j1 * j3),
        0.5 + 0.5 * (j2 * j2 + j3 * j3),
    )
    return w, inverse, (u, v), (u - m[2, k], v - m[3, k]), covariance


@kernel
def _rows_of_block(model, m, threshold_sq, soft_sq, start, stop, rows):
    """Whitened residuals (rows 0, 10) and derivatives by the entries of H (1:10, 11:20), zero where truncated.

    du/dh = (p, 0, -u p), dv/dh = (0, p, -v p) with p = x1 / w; both are multiplied by the inverse Cholesky factor of C.
    """
    h, error = nine(model, 0), rows[len(rows) - 1]
    for k in range(start, stop):
        w, inverse, (u, v), (du, dv), (c0, c1, c2) = transfer(h, m, k)
        f0 = 1.0 / math.sqrt(c0)
        f2 = 1.0 / math.sqrt(c2 - c1 * c1 / c0)
        f1 = -c1 / c0 * f2
        ru, rv = f0 * du, f1 * du + f2 * dv
        r = ru * ru + rv * rv
        is_in = w > 0.0 and r < threshold_sq
        keep, i = (math.sqrt(1.0 / (1.0 + r / soft_sq)) if is_in else 0.0), k - start
        error[i] = r if is_in else threshold_sq
        x, y, z = keep * m[0, k] * inverse, keep * m[1, k] * inverse, keep * inverse
        g0, g1, g2, g3 = f0, f1, f2, f1 * u + f2 * v
        rows[0, i], rows[10, i] = keep * ru, keep * rv
        rows[1, i], rows[2, i], rows[3, i] = g0 * x, g0 * y, g0 * z
        rows[4, i], rows[5, i], rows[6, i] = 0.0, 0.0, 0.0
        rows[7, i], rows[8, i], rows[9, i] = -g0 * u * x, -g0 * u * y, -g0 * u * z
        rows[11, i], rows[12, i], rows[13, i] = g1 * x, g1 * y, g1 * z
        rows[14, i], rows[15, i], rows[16, i] = g2 * x, g2 * y, g2 * z
        rows[17, i], rows[18, i], rows[19, i] = -g3 * x, -g3 * y, -g3 * z


@kernel
def retract_matrix(model, delta, out):
    """Model + delta, of unit length."""
    norm = 0.0
    for i in range(9):
        out[i] = model[i] + delta[i]
        norm += out[i] * out[i]
    norm = 1.0 / math.sqrt(norm)
    for i in range(9):
        out[i] *= norm


class HomographyProblem(RobustProblem, Items):
    """Normalized matches, rows u1, v1, u2, v2."""

    has_unit_steps = True

    def breadth(self):
        """Real planes are not exactly plane, and deviations are larger than any pixel threshold."""
        return 1.5

    __slots__ = ()

    def sample_size(self):
        return np.int64(4)

    def degrees_of_freedom(self):
        return np.int64(9)

    def residual_size(self):
        return np.int64(2)

    def workspace(self):
        return np.empty((4, 3)), np.empty((4, 3))

    def solve_sample(self, sample, models, work):
        x1, x2 = work
        gather(self.items, sample, x1, x2)
        if not homography_four_point(x1, x2, models[0]):
            return np.int64(0)
        h = models[0]
        if h[6] * x1[0, 0] + h[7] * x1[0, 1] + h[8] < 0.0:
            for i in range(9):
                h[i] = -h[i]
        return np.int64(1)

    def error_sq(self, model, threshold_sq, k):
        w, _, _, (du, dv), (c0, c1, c2) = transfer(nine(model, 0), self.items, k)
        r = (c2 * du * du - 2.0 * c1 * du * dv + c0 * dv * dv) / (c0 * c2 - c1 * c1)
        return r if w > 0.0 else math.inf

    def rows_of_block(self, model, threshold_sq, soft_sq, start, stop, rows):
        return _rows_of_block(model, self.items, threshold_sq, soft_sq, start, stop, rows)

    def fix_gauge(self, model, a):
        # One parameter too many: the scale of H has no effect; a penalty on it leaves the other steps unchanged.
        weight = (a[0, 0] + a[4, 4] + a[8, 8]) / 3.0
        for i in range(9):
            for j in range(i + 1):
                a[i, j] += weight * model[i] * model[j]

    def retract(self, model, delta, out):
        retract_matrix(model, delta, out)

    def with_items(self, items):
        return HomographyProblem(items)
