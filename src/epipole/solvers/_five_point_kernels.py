"""The essential matrix from five correspondences (Nister 2004), and the constraints shared by its solvers."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.solvers._linear_kernels import clear, clear_rows, null_space, reduce_rows
from epipole.solvers._polynomial_kernels import real_roots, roots_workspace

# Monomials of degree <= 3 in x, y, z in Nister's order: x3 y3 x2y xy2 x2z x2 y2z y2 xyz xy | xz2 xz x yz2 yz y z3 z2 z 1.
_CUBICS = [
    (3, 0, 0),
    (0, 3, 0),
    (2, 1, 0),
    (1, 2, 0),
    (2, 0, 1),
    (2, 0, 0),
    (0, 2, 1),
    (0, 2, 0),
    (1, 1, 1),
    (1, 1, 0),
    (1, 0, 2),
    (1, 0, 1),
    (1, 0, 0),
    (0, 1, 2),
    (0, 1, 1),
    (0, 1, 0),
    (0, 0, 3),
    (0, 0, 2),
    (0, 0, 1),
    (0, 0, 0),
]
_LINEARS = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)]
_QUADRATICS = [m for m in _CUBICS if sum(m) <= 2]


def _product_table(left, right, out):
    """Index of the product of two monomials."""
    add = [[out.index(tuple(a + b for a, b in zip(m, n))) for n in right] for m in left]
    return np.array(add, dtype=np.int64)


LINEAR_TIMES_LINEAR = _product_table(_LINEARS, _LINEARS, _QUADRATICS)
QUADRATIC_TIMES_LINEAR = _product_table(_QUADRATICS, _LINEARS, _CUBICS)


@kernel
def _add_linear_product(a, b, out, sign):
    for i in range(4):
        for j in range(4):
            out[LINEAR_TIMES_LINEAR[i, j]] += sign * a[i] * b[j]


@kernel
def _add_quadratic_product(a, b, out):
    for i in range(10):
        for j in range(4):
            out[QUADRATIC_TIMES_LINEAR[i, j]] += a[i] * b[j]


@kernel
def essential_constraints(e, work, out):
    """Coefficients (10 x 20) of det E = 0 and E E^T E - trace(E E^T) E / 2 = 0 for E with linear entries e (9, 4)."""
    clear_rows(out)
    minor = work[6]
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        clear(minor)
        _add_linear_product(e[3 + a], e[6 + b], minor, 1.0)
        _add_linear_product(e[3 + b], e[6 + a], minor, -1.0)
        _add_quadratic_product(minor, e[c], out[0])
    # Upper triangle of E E^T: work[0..5] = 00 01 02 11 12 22.
    for k in range(6):
        clear(work[k])
    k = 0
    for i in range(3):
        for j in range(i, 3):
            for c in range(3):
                _add_linear_product(e[3 * i + c], e[3 * j + c], work[k], 1.0)
            k += 1
    for m in range(10):
        half = 0.5 * (work[0, m] + work[3, m] + work[5, m])
        work[0, m] -= half
        work[3, m] -= half
        work[5, m] -= half
    for i in range(3):
        for j in range(3):
            for c in range(3):
                low, high = min(i, c), max(i, c)
                _add_quadratic_product(
                    work[low * 2 + high if low < 2 else 5], e[3 * c + j], out[1 + 3 * i + j]
                )


@kernel
def _multiply_add(a, na, b, nb, out, sign):
    """Add the product of two polynomials, given by their first coefficients."""
    for i in range(na):
        for j in range(nb):
            out[i + j] += sign * a[i] * b[j]


@kernel
def essential_five_point(y1, y2, essentials, w):
    """E from five matches: y2^T E y1 = 0 (Nister, PAMI 2004).

    Assumes calibrated rays, (5, 3). Writes up to ten unit-norm matrices (k, 9); returns k. w: workspace of
    `five_point_workspace()`.
    """
    a, basis, e, quadratics, system, b, minor, poly, roots, root_work = w
    for k in range(5):
        for i in range(3):
            for j in range(3):
                a[k, 3 * i + j] = y2[k, i] * y1[k, j]
    null_space(a, basis)
    for i in range(9):
        for m in range(4):
            e[i, m] = basis[m, i]
    essential_constraints(e, quadratics, system)
    if not reduce_rows(system):
        return 0
    # Rows x2z - z x2, y2z - z y2, xyz - z xy leave a 3x3 matrix B(z) with B(z) (x, y, 1)^T = 0.
    for r in range(len(b)):
        clear_rows(b[r])
    for r in range(3):
        upper, lower = system[4 + 2 * r], system[5 + 2 * r]
        for c in range(2):
            first = 10 + 3 * c
            b[r, c, 3] = -lower[first]
            b[r, c, 2] = upper[first] - lower[first + 1]
            b[r, c, 1] = upper[first + 1] - lower[first + 2]
            b[r, c, 0] = upper[first + 2]
        b[r, 2, 4] = -lower[16]
        for d in range(1, 4):
            b[r, 2, d] = upper[19 - d] - lower[20 - d]
        b[r, 2, 0] = upper[19]
    clear(poly)
    for r in range(3):
        p, q = (r + 1) % 3, (r + 2) % 3
        clear(minor)
        _multiply_add(b[p, 0], 4, b[q, 1], 4, minor, 1.0)
        _multiply_add(b[p, 1], 4, b[q, 0], 4, minor, -1.0)
        _multiply_add(minor, 7, b[r, 2], 5, poly, 1.0)
    count = real_roots(poly, root_work, roots)
    found = 0
    for k in range(count):
        if _essential_at_root(b, roots[k], basis, essentials[found]):
            found += 1
    return found


@kernel(allocates=True)
def _essential_at_root(b, z, basis, out):
    """(x, y) from B(z) (x, y, 1)^T = 0 by the cross product of its two most independent rows; then E."""
    v = np.empty((3, 3))
    for r in range(3):
        for c in range(3):
            v[r, c] = b[r, c, 0] + z * (b[r, c, 1] + z * (b[r, c, 2] + z * (b[r, c, 3] + z * b[r, c, 4])))
    best, bx, by, bw = 0.0, 0.0, 0.0, 0.0
    for r in range(3):
        p, q = (r + 1) % 3, (r + 2) % 3
        cx = v[p, 1] * v[q, 2] - v[p, 2] * v[q, 1]
        cy = v[p, 2] * v[q, 0] - v[p, 0] * v[q, 2]
        cw = v[p, 0] * v[q, 1] - v[p, 1] * v[q, 0]
        if abs(cw) > best:
            best, bx, by, bw = abs(cw), cx, cy, cw
    if best == 0.0:
        return False
    x, y = bx / bw, by / bw
    norm = 0.0
    for i in range(9):
        out[i] = x * basis[0, i] + y * basis[1, i] + z * basis[2, i] + basis[3, i]
        norm += out[i] * out[i]
    if not (norm > 0.0 and norm < np.inf):
        return False
    norm = 1.0 / math.sqrt(norm)
    for i in range(9):
        out[i] *= norm
    return True


@kernel(allocates=True)
def five_point_workspace():
    """Working arrays of `essential_five_point`."""
    return (
        np.empty((5, 9)),
        np.empty((4, 9)),
        np.empty((9, 4)),
        np.empty((7, 10)),
        np.empty((10, 20)),
        np.empty((3, 3, 5)),
        np.empty(7),
        np.empty(11),
        np.empty(11),
        roots_workspace(),
    )
