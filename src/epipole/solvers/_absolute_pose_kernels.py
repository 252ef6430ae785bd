"""Minimal solver for the pose of a calibrated camera: three points (P3P)."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.solvers._polynomial_kernels import cubic_roots


@kernel
def _difference_of_conics(m, k, target):
    """a_23 M_k - a_k M_23 for k = 12 or 13: m = (m12, m13, m23, a12, a13, a23); target = xx, yy, zz, xy, xz, yz."""
    if k == 0:
        target[0], target[1], target[2] = m[5], m[5] - m[3], -m[3]
        target[3], target[4], target[5] = -m[5] * m[0], 0.0, m[3] * m[2]
    else:
        target[0], target[1], target[2] = m[5], -m[4], m[5] - m[4]
        target[3], target[4], target[5] = 0.0, -m[5] * m[1], m[4] * m[2]


@kernel
def _det_sym(xx, yy, zz, xy, xz, yz):
    return xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)


@kernel
def _mixed_det(a, b):
    """The coefficient of s in det(a + s b) for symmetric 3 x 3 matrices: trace(adj(a) b)."""
    return (
        b[0] * (a[1] * a[2] - a[5] * a[5])
        + b[1] * (a[0] * a[2] - a[4] * a[4])
        + b[2] * (a[0] * a[1] - a[3] * a[3])
        + 2.0 * b[3] * (a[4] * a[5] - a[3] * a[2])
        + 2.0 * b[4] * (a[3] * a[5] - a[4] * a[1])
        + 2.0 * b[5] * (a[3] * a[4] - a[5] * a[0])
    )


@kernel
def _lines_of_conic(c, lines):
    """The two real lines (rows of lines) of a degenerate conic c; False if they are complex.

    C = p q^T + q p^T up to scale; -adj(C) = (p x q)(p x q)^T, and C + [p x q]x has rank one (HZ section 2.2;
    Richter-Gebert 2011, section 11.1).
    """
    b0 = c[5] * c[5] - c[1] * c[2]
    b1 = c[4] * c[4] - c[0] * c[2]
    b2 = c[3] * c[3] - c[0] * c[1]
    off01 = c[3] * c[2] - c[4] * c[5]
    off02 = c[4] * c[1] - c[3] * c[5]
    off12 = c[5] * c[0] - c[3] * c[4]
    if b0 >= b1 and b0 >= b2:
        if not b0 > 0.0:
            return False
        root = math.sqrt(b0)
        p0, p1, p2 = root, off01 / root, off02 / root
    elif b1 >= b2:
        if not b1 > 0.0:
            return False
        root = math.sqrt(b1)
        p0, p1, p2 = off01 / root, root, off12 / root
    else:
        if not b2 > 0.0:
            return False
        root = math.sqrt(b2)
        p0, p1, p2 = off02 / root, off12 / root, root
    n = (
        (c[0], c[3] - p2, c[4] + p1),
        (c[3] + p2, c[1], c[5] - p0),
        (c[4] - p1, c[5] + p0, c[2]),
    )
    row, column, largest = 0, 0, 0.0
    for i in range(3):
        for j in range(3):
            if abs(n[i][j]) > largest:
                row, column, largest = i, j, abs(n[i][j])
    for i in range(3):
        lines[0, i], lines[1, i] = n[row][i], n[i][column]
    return largest > 0.0


@kernel
def p3p(rays, points, motions, w):
    """cam_from_world from three rays and points: d_i y_i = R X_i + t, d_i > 0.

    Ding, Yang, Larsson, Olsson and Astrom (CVPR 2023): the law of cosines d_i^2 + d_j^2 - 2 d_i d_j m_ij = a_ij gives
    two conics in (d1 : d2 : d3); a root of the cubic det(D1 + s D2) = 0 gives a degenerate conic of their pencil, a pair of
    lines, which intersect a conic in the solutions. Then Newton steps on the three equations, and R from the two triangles.
    Assumes unit rays and non-collinear points.
    Writes up to four motions (R row by row, t); returns their number.
    """
    m, first, second, conic, lines, roots, triangles = w
    m[3], m[4], m[5] = _distance_sq(points, 0, 1), _distance_sq(points, 0, 2), _distance_sq(points, 1, 2)
    m[0], m[1], m[2] = _dot(rays, 0, 1), _dot(rays, 0, 2), _dot(rays, 1, 2)
    size = max(m[3], m[4], m[5])
    if not min(m[3], m[4], m[5]) > 1e-20 * size:
        return 0
    # Distances in units of the largest, so that the coefficients of the cubic are of order one.
    for k in range(3, 6):
        m[k] /= size
    _difference_of_conics(m, 0, first)
    _difference_of_conics(m, 1, second)
    c0 = _det_sym(first[0], first[1], first[2], first[3], first[4], first[5])
    c3 = _det_sym(second[0], second[1], second[2], second[3], second[4], second[5])
    for k in range(cubic_roots(c3, _mixed_det(second, first), _mixed_det(first, second), c0, roots)):
        for i in range(6):
            conic[i] = first[i] + roots[k] * second[i]
        if _lines_of_conic(conic, lines):
            return _meet_lines(rays, points, m, math.sqrt(size), second, lines, triangles, motions)
    return 0


@kernel
def _meet_lines(rays, points, m, unit, conic, lines, triangles, motions):
    """Intersections of the lines l . (d1, d2, d3) = 0 with the conic, as motions."""
    found = 0
    for l in range(2):
        p, q, r = lines[l, 0], lines[l, 1], lines[l, 2]
        # d3 = 1; whichever of d1 and d2 has the larger coefficient is a linear function of the other.
        swap = abs(p) > abs(q)
        if swap:
            slope, start = -q / p, -r / p
            a = conic[1] + slope * (2.0 * conic[3] + slope * conic[0])
            b = conic[5] + conic[3] * start + slope * (conic[4] + conic[0] * start)
            c = conic[2] + start * (2.0 * conic[4] + start * conic[0])
        elif q != 0.0:
            slope, start = -p / q, -r / q
            a = conic[0] + slope * (2.0 * conic[3] + slope * conic[1])
            b = conic[4] + conic[3] * start + slope * (conic[5] + conic[1] * start)
            c = conic[2] + start * (2.0 * conic[5] + start * conic[1])
        else:
            continue
        discriminant = b * b - a * c
        if discriminant < 0.0 or a == 0.0:
            continue
        big = -(b + math.copysign(math.sqrt(discriminant), b))
        for k in range(2):
            if k == 1 and big == 0.0:
                break
            free = big / a if k == 0 else c / big
            other = slope * free + start
            d1, d2 = (other, free) if swap else (free, other)
            if not (d1 > 0.0 and d2 > 0.0):
                continue
            d3 = unit * math.sqrt(m[4] / (d1 * d1 + 1.0 - 2.0 * d1 * m[1]))
            square = unit * unit
            if _motion_from_depths(
                rays,
                points,
                d1 * d3,
                d2 * d3,
                d3,
                m[2],
                m[1],
                m[0],
                square * m[5],
                square * m[4],
                square * m[3],
                triangles,
                motions[found],
            ):
                found += 1
    return found


@kernel(allocates=True)
def p3p_workspace():
    """Working arrays of `p3p`."""
    return (
        np.empty(6),
        np.empty(6),
        np.empty(6),
        np.empty(6),
        np.empty((2, 3)),
        np.empty(3),
        np.empty((2, 3, 3)),
    )


@kernel
def _distance_sq(p, i, j):
    return (p[i, 0] - p[j, 0]) ** 2 + (p[i, 1] - p[j, 1]) ** 2 + (p[i, 2] - p[j, 2]) ** 2


@kernel
def _dot(p, i, j):
    return p[i, 0] * p[j, 0] + p[i, 1] * p[j, 1] + p[i, 2] * p[j, 2]


@kernel
def _motion_from_depths(rays, points, s1, s2, s3, ca, cb, cg, a2, b2, c2, triangles, out):
    """Refine the depths on |s_i y_i - s_j y_j|^2 = |X_i - X_j|^2, then compute R, t from the two triangles."""
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
    a, b = triangles[0], triangles[1]
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
    """Orthonormalize columns 0 and 1 and set column 2 to their cross product; False if they are parallel."""
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
