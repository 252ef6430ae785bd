"""Minimal two-view solvers: fundamental matrix (7), homography (4), and motions from E."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.solvers._linear_kernels import null_space, symmetric_eigen
from epipole.solvers._polynomial_kernels import cubic_roots


@kernel
def fundamental_seven_point(x1, x2, fundamentals, w):
    """F from seven matches: x2^T F x1 = 0, det F = 0 (Hartley and Zisserman, section 11.1.2).

    Assumes normalized coordinates. Writes up to three matrices (k, 9); returns k.
    """
    a, basis, roots = w
    for k in range(7):
        for i in range(3):
            for j in range(3):
                a[k, 3 * i + j] = x2[k, i] * x1[k, j]
    null_space(a, basis)
    f, g = basis[0], basis[1]
    # det(f + s g) = c0 + c1 s + c2 s^2 + c3 s^3, each coefficient a sum over rows taken from f or g.
    count = cubic_roots(
        _det_rows(g, g, g),
        _det_rows(f, g, g) + _det_rows(g, f, g) + _det_rows(g, g, f),
        _det_rows(g, f, f) + _det_rows(f, g, f) + _det_rows(f, f, g),
        _det_rows(f, f, f),
        roots,
    )
    for k in range(count):
        norm = math.sqrt(1.0 + roots[k] * roots[k])
        for i in range(9):
            fundamentals[k, i] = (f[i] + roots[k] * g[i]) / norm
    return count


@kernel
def _det_rows(a, b, c):
    return (
        a[0] * (b[4] * c[8] - b[5] * c[7])
        - a[1] * (b[3] * c[8] - b[5] * c[6])
        + a[2] * (b[3] * c[7] - b[4] * c[6])
    )


@kernel(allocates=True)
def seven_point_workspace():
    """Working arrays of `fundamental_seven_point`."""
    return np.empty((7, 9)), np.empty((2, 9)), np.empty(3)


@kernel
def _projective_basis(x, out):
    """B (3 x 3) that maps the unit vectors and (1, 1, 1) onto four points (4, 3); False if three are collinear."""
    ax, ay, aw = x[0, 0], x[0, 1], x[0, 2]
    bx, by, bw = x[1, 0], x[1, 1], x[1, 2]
    cx, cy, cw = x[2, 0], x[2, 1], x[2, 2]
    dx, dy, dw = x[3, 0], x[3, 1], x[3, 2]
    la = dx * (by * cw - bw * cy) - dy * (bx * cw - bw * cx) + dw * (bx * cy - by * cx)
    lb = ax * (dy * cw - dw * cy) - ay * (dx * cw - dw * cx) + aw * (dx * cy - dy * cx)
    lc = ax * (by * dw - bw * dy) - ay * (bx * dw - bw * dx) + aw * (bx * dy - by * dx)
    det = ax * (by * cw - bw * cy) - ay * (bx * cw - bw * cx) + aw * (bx * cy - by * cx)
    if min(abs(la), abs(lb), abs(lc), abs(det)) < 1e-10:
        return False
    out[0], out[1], out[2] = la * ax, lb * bx, lc * cx
    out[3], out[4], out[5] = la * ay, lb * by, lc * cy
    out[6], out[7], out[8] = la * aw, lb * bw, lc * cw
    return True


@kernel(allocates=True)
def homography_four_point(x1, x2, out):
    """H from four matches, x2 ~ H x1, through the projective bases of both quadrangles (HZ section 2.3).

    Assumes that no three points are collinear, and normalized coordinates. Returns whether one was found.
    """
    a, b, inverse = np.empty(9), np.empty(9), np.empty(9)
    if not (_projective_basis(x1, a) and _projective_basis(x2, b)):
        return False
    for i in range(3):
        for j in range(3):
            p, q, r, s = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            inverse[3 * i + j] = a[3 * p + r] * a[3 * q + s] - a[3 * p + s] * a[3 * q + r]
    norm = 0.0
    for i in range(3):
        for j in range(3):
            out[3 * i + j] = (
                b[3 * i] * inverse[j] + b[3 * i + 1] * inverse[3 + j] + b[3 * i + 2] * inverse[6 + j]
            )
            norm += out[3 * i + j] ** 2
    if not norm > 0.0:
        return False
    norm = 1.0 / math.sqrt(norm)
    for i in range(9):
        out[i] *= norm
    # A quadrangle seen from in front keeps its orientation: the weights of all four points have the same sign.
    weight = out[6] * x1[0, 0] + out[7] * x1[0, 1] + out[8] * x1[0, 2]
    for k in range(1, 4):
        if weight * (out[6] * x1[k, 0] + out[7] * x1[k, 1] + out[8] * x1[k, 2]) <= 0.0:
            return False
    return True


@kernel(allocates=True)
def svd3(m, u, s, v):
    """M (3 x 3) = u diag(s) v^T with proper rotations u, v and s0 >= s1 >= |s2|.

    Jacobi on m^T m; the last column is completed by the cross product, so that rank two is exact.
    """
    a, vectors = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            a[i, j] = m[0, i] * m[0, j] + m[1, i] * m[1, j] + m[2, i] * m[2, j]
    symmetric_eigen(a, vectors)
    first, last = 0, 0
    for i in range(1, 3):
        if a[i, i] > a[first, first]:
            first = i
        if a[i, i] <= a[last, last]:
            last = i
    middle = 3 - first - last
    if first == last:
        first, middle, last = 0, 1, 2
    for i in range(3):
        v[i, 0], v[i, 1] = vectors[i, first], vectors[i, middle]
    for k in range(2):
        for i in range(3):
            u[i, k] = m[i, 0] * v[0, k] + m[i, 1] * v[1, k] + m[i, 2] * v[2, k]
        if k == 1:
            dot = u[0, 0] * u[0, 1] + u[1, 0] * u[1, 1] + u[2, 0] * u[2, 1]
            for i in range(3):
                u[i, 1] -= dot * u[i, 0]
        s[k] = math.sqrt(u[0, k] ** 2 + u[1, k] ** 2 + u[2, k] ** 2)
        if not s[k] > 1e-300:
            return False
        for i in range(3):
            u[i, k] /= s[k]
    for x in (u, v):
        x[0, 2] = x[1, 0] * x[2, 1] - x[2, 0] * x[1, 1]
        x[1, 2] = x[2, 0] * x[0, 1] - x[0, 0] * x[2, 1]
        x[2, 2] = x[0, 0] * x[1, 1] - x[1, 0] * x[0, 1]
    s[2] = 0.0
    for i in range(3):
        for j in range(3):
            s[2] += u[i, 2] * m[i, j] * v[j, 2]
    return True


@kernel
def essential_from_motion(motion, out):
    """E = [t]x R from motion = (R row by row, t)."""
    tx, ty, tz = motion[9], motion[10], motion[11]
    for j in range(3):
        out[j] = ty * motion[6 + j] - tz * motion[3 + j]
        out[3 + j] = tz * motion[j] - tx * motion[6 + j]
        out[6 + j] = tx * motion[3 + j] - ty * motion[j]


@kernel
def is_in_front(motion, a, b):
    """Whether the rays a (camera 1) and b (camera 2) meet in front of both cameras; their lengths do not matter."""
    ax = motion[0] * a[0] + motion[1] * a[1] + motion[2] * a[2]
    ay = motion[3] * a[0] + motion[4] * a[1] + motion[5] * a[2]
    az = motion[6] * a[0] + motion[7] * a[1] + motion[8] * a[2]
    tx, ty, tz = motion[9], motion[10], motion[11]
    ab = ax * b[0] + ay * b[1] + az * b[2]
    aa = ax * ax + ay * ay + az * az
    bb = b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
    at = ax * tx + ay * ty + az * tz
    bt = b[0] * tx + b[1] * ty + b[2] * tz
    # Depths times the positive determinant aa bb - ab^2 of min |l1 R a + t - l2 b|.
    return ab * bt - bb * at > 0.0 and aa * bt - ab * at > 0.0


@kernel(allocates=True)
def motions_from_essential(e, y1, y2, motions):
    """The motions (R, t), |t| = 1, of the four of E that put all matches in front (HZ result 9.19).

    E = [b]x R gives b b^T = tr(E E^T) I / 2 - E E^T and (b . b) R = cof(E) - [b]x E; -b gives the other rotation
    (Horn, JOSA A 1991). Assumes that E is essential to rounding, as from a minimal solver.
    """
    norms, t, moved = np.empty(3), np.empty(3), np.empty(9)
    trace = 0.0
    for i in range(3):
        norms[i] = e[3 * i] ** 2 + e[3 * i + 1] ** 2 + e[3 * i + 2] ** 2
        trace += norms[i]
    k = 0
    for i in range(1, 3):
        if norms[i] < norms[k]:  # the largest diagonal entry of b b^T
            k = i
    square = 0.5 * trace - norms[k]
    if not square > 1e-300:
        return 0
    for i in range(3):
        t[i] = (
            square
            if i == k
            else -(e[3 * i] * e[3 * k] + e[3 * i + 1] * e[3 * k + 1] + e[3 * i + 2] * e[3 * k + 2])
        )
    norm = math.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
    size = math.sqrt(0.5 * trace)
    for i in range(3):
        t[i] /= norm
    for j in range(3):
        moved[j] = size * (t[1] * e[6 + j] - t[2] * e[3 + j])
        moved[3 + j] = size * (t[2] * e[j] - t[0] * e[6 + j])
        moved[6 + j] = size * (t[0] * e[3 + j] - t[1] * e[j])
    found = 0
    for which in range(4):
        rotation, sign = (1.0 if which < 2 else -1.0), (1.0 if which % 2 == 0 else -1.0)
        out = motions[found]
        for i in range(3):
            p, q = 3 * ((i + 1) % 3), 3 * ((i + 2) % 3)
            for j in range(3):
                m, n = (j + 1) % 3, (j + 2) % 3
                cofactor = e[p + m] * e[q + n] - e[p + n] * e[q + m]
                out[3 * i + j] = cofactor - rotation * moved[3 * i + j]
            out[9 + i] = sign * t[i]
        if not orthonormalize_rows(out):
            return found
        in_front = True
        for k in range(len(y1)):
            in_front = in_front and is_in_front(out, y1[k], y2[k])
        found += 1 if in_front else 0
        if found == len(motions):
            return found
    return found


@kernel
def orthonormalize_rows(r):
    """Gram-Schmidt on the first two rows of r (9 numbers, row by row); the third is their cross product."""
    for i in range(2):
        if i == 1:
            dot = r[0] * r[3] + r[1] * r[4] + r[2] * r[5]
            for j in range(3):
                r[3 + j] -= dot * r[j]
        norm = math.sqrt(r[3 * i] ** 2 + r[3 * i + 1] ** 2 + r[3 * i + 2] ** 2)
        if not norm > 1e-150:
            return False
        for j in range(3):
            r[3 * i + j] /= norm
    for j in range(3):
        m, n = (j + 1) % 3, (j + 2) % 3
        r[6 + j] = r[m] * r[3 + n] - r[n] * r[3 + m]
    return True
