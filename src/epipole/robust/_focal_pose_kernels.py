"""Absolute pose and focal length of an undistorted camera, for the robust loop.

Model: R row by row, t, f. Residual: f (x / z, y / z) - (u, v), pixels relative to the principal point.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.robust._absolute_pose_kernels import retract_motion
from epipole.robust._problem_kernels import Items, RobustProblem
from epipole.solvers._linear_kernels import copy_numbers
from epipole.solvers._more_pose_kernels import FOCAL as FOCAL
from epipole.solvers._more_pose_kernels import p4pf, p4pf_workspace


@kernel
def _rows_of_block(p, m, threshold_sq, soft_sq, start, stop, rows):
    """Residuals (rows 0, 8) and derivatives by (translation, rotation, log f) (1:8, 9:16), zero where truncated."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8]
    t0, t1, t2, f = p[9], p[10], p[11], p[FOCAL]
    error = rows[len(rows) - 1]
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
        keep, i = (math.sqrt(1.0 / (1.0 + r / soft_sq)) if is_in else 0.0), k - start
        error[i] = r if is_in else threshold_sq
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


class FocalPoseProblem(RobustProblem, Items):
    """Normalized points, rows X (3), u, v; pixels in units of the image spread."""

    __slots__ = ()

    def sample_size(self):
        return np.int64(4)

    def degrees_of_freedom(self):
        return np.int64(7)

    def residual_size(self):
        return np.int64(2)

    def workspace(self):
        return np.empty((4, 2)), np.empty((4, 3)), np.empty((8, 13)), p4pf_workspace()

    def solve_sample(self, sample, models, work):
        pixels, points, found, solver = work
        for k in range(4):
            for i in range(3):
                points[k, i] = self.items[i, sample[k]]
            pixels[k, 0], pixels[k, 1] = self.items[3, sample[k]], self.items[4, sample[k]]
        count = p4pf(pixels, points, found, solver)
        for k in range(count):
            copy_numbers(found[k], models[k])
        return count

    def error_sq(self, model, threshold_sq, k):
        p, m = model, self.items
        a, b, c = m[0, k], m[1, k], m[2, k]
        z = p[6] * a + p[7] * b + p[8] * c + p[11]
        u = p[FOCAL] * (p[0] * a + p[1] * b + p[2] * c + p[9]) - z * m[3, k]
        v = p[FOCAL] * (p[3] * a + p[4] * b + p[5] * c + p[10]) - z * m[4, k]
        r = (u * u + v * v) / (z * z + 1e-300)
        return r if z > 0.0 else math.inf

    def rows_of_block(self, model, threshold_sq, soft_sq, start, stop, rows):
        return _rows_of_block(model, self.items, threshold_sq, soft_sq, start, stop, rows)

    def retract(self, model, delta, out):
        retract_motion(model, delta, out)
        out[FOCAL] = model[FOCAL] * math.exp(min(max(delta[6], -1.0), 1.0))

    def with_items(self, items):
        return FocalPoseProblem(items)
