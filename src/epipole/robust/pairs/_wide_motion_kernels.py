"""Relative pose of wide-angle cameras, for the robust loop.

Model as in `_relative_pose_kernels`. On the plane z = 1, pixels near the border of a fisheye image are strongly stretched.
Here matches are unit rays with their derivatives by the pixels, and the residual is the Sampson distance in the images
themselves (the tangent Sampson error of Terekhov and Larsson, ICCV 2023),

    r = e / sqrt(m), e = y2^T E y1, m = |J2^T E y1|^2 + |J1^T E^T y2|^2, J = dy / du.
"""

import math

from epipole._jit import kernel
from epipole.robust._item_kernels import REASSOC, nine
from epipole.robust._problem_kernels import Items
from epipole.robust.pairs._relative_pose_kernels import MotionProblem, diverge

SECOND, FIRST_SLOPE, SECOND_SLOPE = 3, 6, 12


@kernel(fuse=True)
def tangent_sampson(f, m, k):
    """(e, m, J1^T E^T y2, J2^T E y1): algebraic error, its squared slope, and the slopes by both pixels; f is a tuple."""
    x, y, z, u, v, w = m[0, k], m[1, k], m[2, k], m[3, k], m[4, k], m[5, k]
    l0, l1, l2 = (
        f[0] * x + f[1] * y + f[2] * z,
        f[3] * x + f[4] * y + f[5] * z,
        f[6] * x + f[7] * y + f[8] * z,
    )
    g0, g1, g2 = (
        f[0] * u + f[3] * v + f[6] * w,
        f[1] * u + f[4] * v + f[7] * w,
        f[2] * u + f[5] * v + f[8] * w,
    )
    p0, p1 = m[6, k] * g0 + m[8, k] * g1 + m[10, k] * g2, m[7, k] * g0 + m[9, k] * g1 + m[11, k] * g2
    q0, q1 = m[12, k] * l0 + m[14, k] * l1 + m[16, k] * l2, m[13, k] * l0 + m[15, k] * l1 + m[17, k] * l2
    slope = p0 * p0 + p1 * p1 + q0 * q0 + q1 * q1 + 1e-300
    return u * l0 + v * l1 + w * l2, slope, (p0, p1), (q0, q1)


@kernel(fuse=True)
def _diverge(model, m, k, slack):
    one, two = (m[0, k], m[1, k], m[2, k]), (m[3, k], m[4, k], m[5, k])
    return diverge(nine(model, 0), (model[9], model[10], model[11]), one, two, slack)


@kernel(extra_fastmath=REASSOC)
def _agreeing_block(model, m, threshold_sq, start, stop):
    """Number of matches start..stop with a squared distance below the threshold, in front or not."""
    f, count = nine(model, 12), 0
    for k in range(start, stop):
        e, slope, _, _ = tangent_sampson(f, m, k)
        count += 1 if e * e < threshold_sq * slope else 0
    return count


@kernel
def _rows_of_block(model, m, threshold_sq, soft_sq, start, stop, rows):
    """Residuals (rows[0]) and their derivatives by E (rows[1:10]) of matches start..stop, zero where truncated."""
    slack, f, error = math.sqrt(threshold_sq), nine(model, 12), rows[len(rows) - 1]
    for k in range(start, stop):
        e, slope, one, two = tangent_sampson(f, m, k)
        r = e * e / slope
        is_out = _diverge(model, m, k, slack) or r > threshold_sq
        root = 0.0 if is_out else math.sqrt(1.0 / (slope * (1.0 + r / soft_sq)))
        ratio, n = e / slope, k - start
        error[n] = threshold_sq if is_out else r
        rows[0, n] = root * e
        # dr / dE_ij = (y2_i y1_j - (e / m) ((J2 J2^T E y1)_i y1_j + (J1 J1^T E^T y2)_j y2_i)) / sqrt(m)
        for i in range(3):
            left = m[SECOND + i, k] - ratio * (
                m[SECOND_SLOPE + 2 * i, k] * two[0] + m[SECOND_SLOPE + 2 * i + 1, k] * two[1]
            )
            for j in range(3):
                right = m[FIRST_SLOPE + 2 * j, k] * one[0] + m[FIRST_SLOPE + 2 * j + 1, k] * one[1]
                rows[1 + 3 * i + j, n] = root * (left * m[j, k] - ratio * right * m[SECOND + i, k])


class WideMotionProblem(MotionProblem, Items):
    """Matched rays and their derivatives, (18, n): unit y1, y2, then J1 and J2 (3 x 2, row by row)."""

    __slots__ = ()

    def gather_rays(self, sample, y1, y2):
        for k in range(len(y1)):
            for i in range(3):
                y1[k, i], y2[k, i] = self.items[i, sample[k]], self.items[SECOND + i, sample[k]]

    def agreeing(self, model, threshold_sq, start, stop):
        return _agreeing_block(model, self.items, threshold_sq, start, stop)

    def error_sq(self, model, threshold_sq, k):
        e, slope, _, _ = tangent_sampson(nine(model, 12), self.items, k)
        return math.inf if _diverge(model, self.items, k, math.sqrt(threshold_sq)) else e * e / slope

    def rows_of_block(self, model, threshold_sq, soft_sq, start, stop, rows):
        return _rows_of_block(model, self.items, threshold_sq, soft_sq, start, stop, rows)

    def with_items(self, items):
        return WideMotionProblem(items)
