"""Absolute pose of a calibrated camera or camera rig, for the robust loop.

Model: motion (R row by row, t) = rig_from_world. Item k: a point X, and a ray from o in the direction d (unit) with
the derivative J (2 x 3) of its pixel by its direction, all in rig coordinates. To first order in the error

    r = J x / (d . x),   x = R X + t - o,

in pixels of the actual camera model: J d = 0, and x / (d . x) lies on the plane tangent to the unit sphere at d. Points
behind the camera have infinite error.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import NUM_PARAMS, project_with_jacobian_one, unproject_one
from epipole.robust._item_kernels import rotate_left
from epipole.robust._problem_kernels import Items, RobustProblem
from epipole.solvers._absolute_pose_kernels import p3p, p3p_workspace
from epipole.solvers._linear_kernels import copy_numbers

ROWS = 15


@kernel(allocates=True)
def pack_rays(model, params, cam_from_rig, points, pixels, order, items):
    """Columns of `items` (15, m) for the points `order` (m,) and their pixels in one camera of a rig.

    Pixels without a ray give NaN.
    """
    jac, jac_params, r = np.empty((2, 3)), np.empty((2, NUM_PARAMS)), cam_from_rig
    for column in range(len(order)):
        k = order[column]
        x, y, z = unproject_one(model, params, pixels[k, 0], pixels[k, 1])
        u, _ = project_with_jacobian_one(model, params, x, y, z, jac, jac_params)
        valid = 1.0 if u == u else math.nan
        for i in range(3):
            items[i, column] = points[k, i]
            items[3 + i, column] = r[i] * x + r[3 + i] * y + r[6 + i] * z
            for j in range(2):
                rotated = jac[j, 0] * r[i] + jac[j, 1] * r[3 + i] + jac[j, 2] * r[6 + i]
                items[6 + 3 * j + i, column] = valid * rotated
            items[12 + i, column] = -(r[i] * r[9] + r[3 + i] * r[10] + r[6 + i] * r[11])


@kernel
def _rows_of_block(p, m, threshold_sq, soft_sq, start, stop, rows):
    """Residuals (rows 0 and 7) and derivatives by (translation, rotation) (rows 1:7 and 8:14), zero where truncated.

    With w = (J_i - r_i d) / (d . x): dr_i / dt = w and dr_i / dphi = (x + o) x w, x + o = R X + t.
    """
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8]
    t0, t1, t2 = p[9], p[10], p[11]
    error = rows[len(rows) - 1]
    for k in range(start, stop):
        a, b, c = m[0, k], m[1, k], m[2, k]
        gx = r0 * a + r1 * b + r2 * c + t0
        gy = r3 * a + r4 * b + r5 * c + t1
        gz = r6 * a + r7 * b + r8 * c + t2
        x, y, z = gx - m[12, k], gy - m[13, k], gz - m[14, k]
        s = m[3, k] * x + m[4, k] * y + m[5, k] * z
        inverse = 1.0 / (s if s > 0.0 else 1.0)
        u = (m[6, k] * x + m[7, k] * y + m[8, k] * z) * inverse
        v = (m[9, k] * x + m[10, k] * y + m[11, k] * z) * inverse
        r = u * u + v * v
        is_in = s > 0.0 and r < threshold_sq
        keep = math.sqrt(1.0 / (1.0 + r / soft_sq)) if is_in else 0.0
        scale, i = keep * inverse, k - start
        error[i] = r if is_in else threshold_sq
        wx, wy, wz = (
            (m[6, k] - u * m[3, k]) * scale,
            (m[7, k] - u * m[4, k]) * scale,
            (m[8, k] - u * m[5, k]) * scale,
        )
        rows[0, i] = keep * u
        rows[1, i], rows[2, i], rows[3, i] = wx, wy, wz
        rows[4, i], rows[5, i], rows[6, i] = gy * wz - gz * wy, gz * wx - gx * wz, gx * wy - gy * wx
        wx, wy, wz = (
            (m[9, k] - v * m[3, k]) * scale,
            (m[10, k] - v * m[4, k]) * scale,
            (m[11, k] - v * m[5, k]) * scale,
        )
        rows[7, i] = keep * v
        rows[8, i], rows[9, i], rows[10, i] = wx, wy, wz
        rows[11, i], rows[12, i], rows[13, i] = gy * wz - gz * wy, gz * wx - gx * wz, gx * wy - gy * wx


@kernel
def retract_motion(motion, delta, out):
    """exp(xi) @ motion for the twist xi = (rho, phi), translation and rotation."""
    rotate_left(delta[3:6], motion, out)
    x, y, z = delta[3], delta[4], delta[5]
    angle = math.sqrt(x * x + y * y + z * z)
    first = 1.0 - angle * angle / 6.0 if angle < 1e-4 else math.sin(angle) / angle
    second = 0.5 - angle * angle / 24.0 if angle < 1e-4 else (1.0 - math.cos(angle)) / (angle * angle)
    a, b, c = motion[9], motion[10], motion[11]
    u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
    out[9] = a + first * u + second * (y * w - z * v) + delta[0]
    out[10] = b + first * v + second * (z * u - x * w) + delta[1]
    out[11] = c + first * w + second * (x * v - y * u) + delta[2]


class RayPoseProblem(RobustProblem):
    """Residuals and refinement of a pose from rays, for any minimal solver; items (15, n): X, d, J0, J1, o."""

    __slots__ = ()

    def degrees_of_freedom(self):
        return np.int64(6)

    def residual_size(self):
        return np.int64(2)

    def error_sq(self, model, threshold_sq, k):
        p, m = model, self.items
        a, b, c = m[0, k], m[1, k], m[2, k]
        x = p[0] * a + p[1] * b + p[2] * c + p[9] - m[12, k]
        y = p[3] * a + p[4] * b + p[5] * c + p[10] - m[13, k]
        z = p[6] * a + p[7] * b + p[8] * c + p[11] - m[14, k]
        s = m[3, k] * x + m[4, k] * y + m[5, k] * z
        u = m[6, k] * x + m[7, k] * y + m[8, k] * z
        v = m[9, k] * x + m[10, k] * y + m[11, k] * z
        r = (u * u + v * v) / (s * s + 1e-300)
        return r if s > 0.0 else math.inf

    def rows_of_block(self, model, threshold_sq, soft_sq, start, stop, rows):
        return _rows_of_block(model, self.items, threshold_sq, soft_sq, start, stop, rows)

    def retract(self, model, delta, out):
        retract_motion(model, delta, out)


class AbsolutePoseProblem(RayPoseProblem, Items):
    """One camera: all rays share their origin."""

    __slots__ = ()

    def sample_size(self):
        return np.int64(3)

    def workspace(self):
        return np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 12)), p3p_workspace()

    def solve_sample(self, sample, models, work):
        rays, points, found, solver = work
        for k in range(3):
            for i in range(3):
                points[k, i], rays[k, i] = self.items[i, sample[k]], self.items[3 + i, sample[k]]
        count = p3p(rays, points, found, solver)
        for k in range(count):
            copy_numbers(found[k], models[k])
        return count

    def with_items(self, items):
        return AbsolutePoseProblem(items)
