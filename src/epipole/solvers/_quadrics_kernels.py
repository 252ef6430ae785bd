"""Intersection of three quadrics in three unknowns (E3Q3)."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.solvers._linear_kernels import clear, clear_rows, reduce_rows
from epipole.solvers._polynomial_kernels import real_roots, roots_workspace

# Coefficients of a quadric: x2 xy xz y2 yz z2 x y z 1.
FLAT = 1e-7  # determinant of the leading coefficients below which another variable is hidden


@kernel
def _multiply(a, na, b, nb, sign, out):
    """Out += sign a b for polynomials of na and nb coefficients."""
    for i in range(na):
        for j in range(nb):
            out[i + j] += sign * a[i] * b[j]


@kernel
def _add(a, na, sign, out):
    for i in range(na):
        out[i] += sign * a[i]


@kernel
def _permuted(c, rotation, out):
    """The same quadrics with (x, y, z) permuted cyclically, to hide another variable."""
    for r in range(3):
        if rotation == 0:
            for k in range(10):
                out[r, k] = c[r, k]
        elif rotation == 1:  # old (x, y, z) = new (z, x, y)
            out[r, 0], out[r, 1], out[r, 2], out[r, 3], out[r, 4] = (
                c[r, 3],
                c[r, 4],
                c[r, 1],
                c[r, 5],
                c[r, 2],
            )
            out[r, 5], out[r, 6], out[r, 7], out[r, 8], out[r, 9] = (
                c[r, 0],
                c[r, 7],
                c[r, 8],
                c[r, 6],
                c[r, 9],
            )
        else:  # old (x, y, z) = new (y, z, x)
            out[r, 0], out[r, 1], out[r, 2], out[r, 3], out[r, 4] = (
                c[r, 5],
                c[r, 2],
                c[r, 4],
                c[r, 0],
                c[r, 1],
            )
            out[r, 5], out[r, 6], out[r, 7], out[r, 8], out[r, 9] = (
                c[r, 3],
                c[r, 8],
                c[r, 6],
                c[r, 7],
                c[r, 9],
            )


@kernel
def _leading_determinant(c):
    """Determinant of the coefficients of x2, xy, y2, for unit rows."""
    product = 1.0
    for r in range(3):
        norm = 0.0
        for k in range(10):
            norm += c[r, k] * c[r, k]
        product *= math.sqrt(norm) + 1e-300
    return (
        abs(
            c[0, 0] * (c[1, 1] * c[2, 3] - c[1, 3] * c[2, 1])
            - c[0, 1] * (c[1, 0] * c[2, 3] - c[1, 3] * c[2, 0])
            + c[0, 3] * (c[1, 0] * c[2, 1] - c[1, 1] * c[2, 0])
        )
        / product
    )


@kernel(allocates=True)
def quadrics_workspace():
    """Working arrays of `intersect_quadrics`."""
    return (
        np.empty((3, 10)),
        np.empty((3, 10)),
        np.empty((3, 3, 3)),
        np.empty((3, 3, 5)),
        np.empty((4, 5)),
        np.empty(9),
        np.empty(9),
        np.empty(9),
        roots_workspace(),
    )


@kernel
def intersect_quadrics(c, solutions, w):
    """Real intersections (k, 3) of three quadrics (3, 10); returns k, at most 8.

    Kukelova, Heller and Fitzgibbon (CVPR 2016): with z hidden, x2, xy and y2 are linear in (x, y, 1); the identities
    x (xy) = y (x2), y (xy) = x (y2) and (xy)^2 = x2 y2 then give M(z) (x, y, 1)^T = 0, whose determinant has degree 8.
    Assumes that some variable can be hidden (the leading coefficients of the other two are independent).
    """
    q, system, p, m, t, poly, minor, roots, root_work = w
    rotation, best = 0, -1.0
    for k in range(3):
        _permuted(c, k, q)
        this = _leading_determinant(q)
        if this > best:
            rotation, best = k, this
    if not best > FLAT:
        return 0
    _permuted(c, rotation, q)
    for r in range(3):
        system[r, 0], system[r, 1], system[r, 2] = q[r, 0], q[r, 1], q[r, 3]
        # -(x: xz z + x), -(y: yz z + y), -(1: z2 z^2 + z z + 1)
        system[r, 3], system[r, 4], system[r, 5] = -q[r, 6], -q[r, 2], -q[r, 7]
        system[r, 6], system[r, 7], system[r, 8], system[r, 9] = -q[r, 4], -q[r, 9], -q[r, 8], -q[r, 5]
    if not reduce_rows(system):
        return 0
    for r in range(3):
        p[r, 0, 0], p[r, 0, 1], p[r, 0, 2] = system[r, 3], system[r, 4], 0.0
        p[r, 1, 0], p[r, 1, 1], p[r, 1, 2] = system[r, 5], system[r, 6], 0.0
        p[r, 2, 0], p[r, 2, 1], p[r, 2, 2] = system[r, 7], system[r, 8], system[r, 9]
    _fill_matrix(p, m, t)
    clear(poly)
    for column in range(3):
        a, b = (column + 1) % 3, (column + 2) % 3
        clear(minor)
        _multiply(m[0, a], 4, m[1, b], 4, 1.0, minor)
        _multiply(m[0, b], 4, m[1, a], 4, -1.0, minor)
        # Minors have degree 4 or 5, the last row 3 or 4; the product never exceeds 8.
        for i in range(6):
            for j in range(5):
                if i + j < 9:
                    poly[i + j] += minor[i] * m[2, column, j]
    found = 0
    for k in range(real_roots(poly, root_work, roots)):
        if _complete(m, roots[k], solutions[found]):
            x, y, z = solutions[found, 0], solutions[found, 1], solutions[found, 2]
            if rotation == 1:
                solutions[found, 0], solutions[found, 1], solutions[found, 2] = z, x, y
            elif rotation == 2:
                solutions[found, 0], solutions[found, 1], solutions[found, 2] = y, z, x
            _polish(c, solutions[found])
            found += 1
    return found


@kernel
def _fill_matrix(p, m, t):
    """M(z) (3, 3, 5) from x2 = p[0], xy = p[1], y2 = p[2], each (x, y, 1) with polynomials in z."""
    for r in range(len(m)):
        clear_rows(m[r])
    clear_rows(t)
    # x (xy) - y (x2)
    _multiply(p[1, 1], 2, p[1, 0], 2, 1.0, m[0, 0])
    _multiply(p[0, 1], 2, p[2, 0], 2, -1.0, m[0, 0])
    _add(p[1, 2], 3, 1.0, m[0, 0])
    _multiply(p[1, 0], 2, p[0, 1], 2, 1.0, m[0, 1])
    _multiply(p[1, 1], 2, p[1, 1], 2, 1.0, m[0, 1])
    _multiply(p[0, 0], 2, p[1, 1], 2, -1.0, m[0, 1])
    _multiply(p[0, 1], 2, p[2, 1], 2, -1.0, m[0, 1])
    _add(p[0, 2], 3, -1.0, m[0, 1])
    _multiply(p[1, 0], 2, p[0, 2], 3, 1.0, m[0, 2])
    _multiply(p[1, 1], 2, p[1, 2], 3, 1.0, m[0, 2])
    _multiply(p[0, 0], 2, p[1, 2], 3, -1.0, m[0, 2])
    _multiply(p[0, 1], 2, p[2, 2], 3, -1.0, m[0, 2])
    # y (xy) - x (y2)
    _multiply(p[1, 0], 2, p[1, 0], 2, 1.0, m[1, 0])
    _multiply(p[2, 1], 2, p[1, 0], 2, -1.0, m[1, 0])
    _multiply(p[1, 1], 2, p[2, 0], 2, 1.0, m[1, 0])
    _multiply(p[2, 0], 2, p[0, 0], 2, -1.0, m[1, 0])
    _add(p[2, 2], 3, -1.0, m[1, 0])
    _multiply(p[1, 0], 2, p[1, 1], 2, 1.0, m[1, 1])
    _multiply(p[2, 0], 2, p[0, 1], 2, -1.0, m[1, 1])
    _add(p[1, 2], 3, 1.0, m[1, 1])
    _multiply(p[1, 0], 2, p[1, 2], 3, 1.0, m[1, 2])
    _multiply(p[2, 1], 2, p[1, 2], 3, -1.0, m[1, 2])
    _multiply(p[1, 1], 2, p[2, 2], 3, 1.0, m[1, 2])
    _multiply(p[2, 0], 2, p[0, 2], 3, -1.0, m[1, 2])
    # (xy)^2 - x2 y2 = t0 x2 + t1 xy + t2 y2 + linear terms
    _multiply(p[1, 0], 2, p[1, 0], 2, 1.0, t[0])
    _multiply(p[0, 0], 2, p[2, 0], 2, -1.0, t[0])
    _multiply(p[1, 0], 2, p[1, 1], 2, 2.0, t[1])
    _multiply(p[0, 0], 2, p[2, 1], 2, -1.0, t[1])
    _multiply(p[0, 1], 2, p[2, 0], 2, -1.0, t[1])
    _multiply(p[1, 1], 2, p[1, 1], 2, 1.0, t[2])
    _multiply(p[0, 1], 2, p[2, 1], 2, -1.0, t[2])
    for column in range(2):
        _multiply(p[1, column], 2, p[1, 2], 3, 2.0, m[2, column])
        _multiply(p[0, column], 2, p[2, 2], 3, -1.0, m[2, column])
        _multiply(p[0, 2], 3, p[2, column], 2, -1.0, m[2, column])
        for r in range(3):
            _multiply(t[r], 3, p[r, column], 2, 1.0, m[2, column])
    _multiply(p[1, 2], 3, p[1, 2], 3, 1.0, m[2, 2])
    _multiply(p[0, 2], 3, p[2, 2], 3, -1.0, m[2, 2])
    for r in range(3):
        _multiply(t[r], 3, p[r, 2], 3, 1.0, m[2, 2])


@kernel
def _at(m, z):
    return m[0] + z * (m[1] + z * (m[2] + z * (m[3] + z * m[4])))


@kernel
def _complete(m, z, out):
    """(x, y) from M(z) (x, y, 1)^T = 0 by the cross product of its two most independent rows."""
    best, x, y = 0.0, 0.0, 0.0
    for r in range(3):
        a, b = (r + 1) % 3, (r + 2) % 3
        a0, a1, a2 = _at(m[a, 0], z), _at(m[a, 1], z), _at(m[a, 2], z)
        b0, b1, b2 = _at(m[b, 0], z), _at(m[b, 1], z), _at(m[b, 2], z)
        weight = a0 * b1 - a1 * b0
        size = math.sqrt((a0 * a0 + a1 * a1 + a2 * a2) * (b0 * b0 + b1 * b1 + b2 * b2)) + 1e-300
        if abs(weight) / size > best:
            best = abs(weight) / size
            x, y = (a1 * b2 - a2 * b1) / weight, (a2 * b0 - a0 * b2) / weight
    out[0], out[1], out[2] = x, y, z
    return best > 0.0 and abs(x) + abs(y) + abs(z) < math.inf


@kernel
def _polish(c, s):
    """Two Newton steps on the three quadrics."""
    for _ in range(2):
        x, y, z = s[0], s[1], s[2]
        e0, e1, e2 = _quadric(c[0], x, y, z), _quadric(c[1], x, y, z), _quadric(c[2], x, y, z)
        a00, a01, a02 = _slope(c[0], x, y, z)
        a10, a11, a12 = _slope(c[1], x, y, z)
        a20, a21, a22 = _slope(c[2], x, y, z)
        k0, k1, k2 = a11 * a22 - a12 * a21, a12 * a20 - a10 * a22, a10 * a21 - a11 * a20
        det = a00 * k0 + a01 * k1 + a02 * k2
        if det == 0.0:
            return
        dx = (k0 * e0 + (a02 * a21 - a01 * a22) * e1 + (a01 * a12 - a02 * a11) * e2) / det
        dy = (k1 * e0 + (a00 * a22 - a02 * a20) * e1 + (a02 * a10 - a00 * a12) * e2) / det
        dz = (k2 * e0 + (a01 * a20 - a00 * a21) * e1 + (a00 * a11 - a01 * a10) * e2) / det
        if not abs(dx) + abs(dy) + abs(dz) < 0.1 * (abs(x) + abs(y) + abs(z)):
            return
        s[0], s[1], s[2] = x - dx, y - dy, z - dz


@kernel
def _quadric(c, x, y, z):
    return (
        x * (c[0] * x + c[1] * y + c[2] * z + c[6])
        + y * (c[3] * y + c[4] * z + c[7])
        + z * (c[5] * z + c[8])
        + c[9]
    )


@kernel
def _slope(c, x, y, z):
    return (
        2.0 * c[0] * x + c[1] * y + c[2] * z + c[6],
        c[1] * x + 2.0 * c[3] * y + c[4] * z + c[7],
        c[2] * x + c[4] * y + 2.0 * c[5] * z + c[8],
    )
