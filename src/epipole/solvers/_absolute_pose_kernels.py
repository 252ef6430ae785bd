"""Minimal solver for the pose of a calibrated camera: three points (P3P)."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.solvers._polynomial_kernels import real_roots, roots_workspace


@kernel
def p3p(rays, points, motions, w):
    """cam_from_world from three rays and points: s_i y_i = R X_i + t, s_i > 0.

    Grunert's quartic (1841; Haralick et al., IJCV 1994, eq. 9) for the ratio v = s3 / s1, then Newton steps on
    the three distance equations, then R from the two triangles. Assumption: unit rays, points not collinear.
    Writes up to four motions (R row by row, t); returns their number.
    """
    poly, roots, root_work = w
    a2, b2, c2 = _distance_sq(points, 1, 2), _distance_sq(points, 0, 2), _distance_sq(points, 0, 1)
    if not min(a2, b2, c2) > 1e-20:
        return 0
    ca, cb, cg = _dot(rays, 1, 2), _dot(rays, 0, 2), _dot(rays, 0, 1)
    q, sum_ac, c_b, a_b = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2, a2 / b2
    poly[4] = (q - 1.0) ** 2 - 4.0 * c_b * ca * ca
    poly[3] = 4.0 * (q * (1.0 - q) * cb - (1.0 - sum_ac) * ca * cg + 2.0 * c_b * ca * ca * cb)
    poly[2] = 2.0 * (
        q * q
        - 1.0
        + 2.0 * q * q * cb * cb
        + 2.0 * (1.0 - c_b) * ca * ca
        - 4.0 * sum_ac * ca * cb * cg
        + 2.0 * (1.0 - a_b) * cg * cg
    )
    poly[1] = 4.0 * (-q * (1.0 + q) * cb + 2.0 * a_b * cg * cg * cb - (1.0 - sum_ac) * ca * cg)
    poly[0] = (1.0 + q) ** 2 - 4.0 * a_b * cg * cg
    found = 0
    for k in range(real_roots(poly, root_work, roots)):
        v = roots[k]
        below = 2.0 * (cg - v * ca)
        denominator = 1.0 + v * v - 2.0 * v * cb
        if v <= 0.0 or abs(below) < 1e-12 or denominator <= 0.0:
            continue
        u = ((q - 1.0) * v * v - 2.0 * q * cb * v + 1.0 + q) / below
        if u <= 0.0:
            continue
        s1 = math.sqrt(b2 / denominator)
        if _motion_from_depths(rays, points, s1, u * s1, v * s1, ca, cb, cg, a2, b2, c2, motions[found]):
            found += 1
    return found


@kernel(allocates=True)
def p3p_workspace():
    """Arrays that `p3p` writes into."""
    return np.empty(5), np.empty(4), roots_workspace()


@kernel
def _distance_sq(p, i, j):
    return (p[i, 0] - p[j, 0]) ** 2 + (p[i, 1] - p[j, 1]) ** 2 + (p[i, 2] - p[j, 2]) ** 2


@kernel
def _dot(p, i, j):
    return p[i, 0] * p[j, 0] + p[i, 1] * p[j, 1] + p[i, 2] * p[j, 2]


@kernel(allocates=True)
def _motion_from_depths(rays, points, s1, s2, s3, ca, cb, cg, a2, b2, c2, out):
    """Polish the depths on |s_i y_i - s_j y_j|^2 = |X_i - X_j|^2, then R, t from the two triangles."""
    for _ in range(3):
        e1 = s2 * s2 + s3 * s3 - 2.0 * s2 * s3 * ca - a2
        e2 = s1 * s1 + s3 * s3 - 2.0 * s1 * s3 * cb - b2
        e3 = s1 * s1 + s2 * s2 - 2.0 * s1 * s2 * cg - c2
        # Jacobian / 2 = [[0, p, q], [r, 0, s], [t, u, 0]].
        p, q = s2 - s3 * ca, s3 - s2 * ca
        r, s = s1 - s3 * cb, s3 - s1 * cb
        t, u = s1 - s2 * cg, s2 - s1 * cg
        det = 2.0 * (p * s * t + q * r * u)
        if abs(det) < 1e-300:
            return False
        d1 = (-s * u * e1 + q * u * e2 + p * s * e3) / det
        d2 = (s * t * e1 - q * t * e2 + q * r * e3) / det
        d3 = (r * u * e1 + p * t * e2 - p * r * e3) / det
        s1, s2, s3 = s1 - d1, s2 - d2, s3 - d3
    if not (s1 > 0.0 and s2 > 0.0 and s3 > 0.0 and s1 + s2 + s3 < np.inf):
        return False
    a, b = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        a[i, 0], a[i, 1] = points[1, i] - points[0, i], points[2, i] - points[0, i]
        b[i, 0], b[i, 1] = s2 * rays[1, i] - s1 * rays[0, i], s3 * rays[2, i] - s1 * rays[0, i]
    if not (_orthonormalize(a) and _orthonormalize(b)):
        return False
    for i in range(3):
        for j in range(3):
            out[3 * i + j] = b[i, 0] * a[j, 0] + b[i, 1] * a[j, 1] + b[i, 2] * a[j, 2]
    for i in range(3):
        moved = out[3 * i] * points[0, 0] + out[3 * i + 1] * points[0, 1] + out[3 * i + 2] * points[0, 2]
        out[9 + i] = s1 * rays[0, i] - moved
    return True


@kernel
def _orthonormalize(m):
    """Columns 0 and 1 become orthonormal, column 2 their cross product; False if they are parallel."""
    norm = math.sqrt(m[0, 0] ** 2 + m[1, 0] ** 2 + m[2, 0] ** 2)
    if not norm > 1e-12:
        return False
    for i in range(3):
        m[i, 0] /= norm
    dot = m[0, 0] * m[0, 1] + m[1, 0] * m[1, 1] + m[2, 0] * m[2, 1]
    before = math.sqrt(m[0, 1] ** 2 + m[1, 1] ** 2 + m[2, 1] ** 2)
    for i in range(3):
        m[i, 1] -= dot * m[i, 0]
    norm = math.sqrt(m[0, 1] ** 2 + m[1, 1] ** 2 + m[2, 1] ** 2)
    if not norm > 1e-6 * before:
        return False
    for i in range(3):
        m[i, 1] /= norm
    m[0, 2] = m[1, 0] * m[2, 1] - m[2, 0] * m[1, 1]
    m[1, 2] = m[2, 0] * m[0, 1] - m[0, 0] * m[2, 1]
    m[2, 2] = m[0, 0] * m[1, 1] - m[1, 0] * m[0, 1]
    return True
