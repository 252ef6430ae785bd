"""Relative pose of cameras with unknown focal lengths: one for both (six points), or one each (seven points)."""

import math

import numpy as np
from numpy.polynomial.chebyshev import cheb2poly

from epipole._jit import kernel
from epipole.solvers._five_point_kernels import essential_constraints
from epipole.solvers._linear_kernels import null_space
from epipole.solvers._polynomial_kernels import roots_within, roots_workspace

MOST_SHARED = 8
"""Maximum number of solutions that are kept; more within the range of focal lengths are extremely rare."""
DEGREE = 15
LEAST_FOCAL, MOST_FOCAL = 0.25, 8.0
FAR = 100.0  # f^-2 at which the leading term of the polynomial dominates
# Chebyshev nodes, and the map from values there to coefficients, by way of Chebyshev polynomials: inverting the
# Vandermonde matrix would lose six digits.
ANGLES = np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1)
NODES = np.cos(ANGLES)
TO_COEFFICIENTS = sum(
    np.outer(
        np.pad(cheb2poly(np.eye(DEGREE + 1)[n]), (0, DEGREE))[: DEGREE + 1],
        (1.0 if n == 0 else 2.0) / (DEGREE + 1) * np.cos(n * ANGLES),
    )
    for n in range(DEGREE + 1)
)
# Columns of the 20 monomials of the essential constraints without z: x3 y3 x2y xy2 x2 y2 xy x y 1.
WITHOUT_Z = np.array([0, 1, 2, 3, 5, 7, 9, 12, 15, 19])
X, Y = 7, 8  # indices of x and y among them


@kernel
def shared_focal_six_point(x1, x2, essentials, focals, w):
    """E (k, 9) and f (k,) of two cameras with one focal length, from six matches (rows (u, v, 1), normalized pixels).

    x2^T F x1 = 0 leaves F = x F1 + y F2 + F3. For a given focal length the constraints of the essential matrix are ten
    equations in the ten monomials of x and y; their determinant is a polynomial of degree 15 in f^-2 that vanishes at the true
    one (Stewenius et al. 2005; Kukelova, Bujnak and Pajdla, BMVC 2008). It is interpolated from 16 focal lengths; its roots
    between a quarter and eight units, the plausible range, are polished on the determinant. Assumes square pixels, no
    distortion, and principal points at zero. Returns k, at most 8.
    """
    a, basis, constraints, lu, values, poly, roots, root_work, v, work = w
    for k in range(6):
        for i in range(3):
            for j in range(3):
                a[k, 3 * i + j] = x2[k, i] * x1[k, j]
    null_space(a, basis)
    _constraint_polynomial(basis, constraints, work)
    mean = _determinant_polynomial(constraints, lu, values, poly)
    found = 0
    for k in range(roots_within(poly, 1.0, root_work, roots)):
        square = mean * (1.0 + roots[k]) / (1.0 - roots[k])
        if found == MOST_SHARED or not MOST_FOCAL**-2 <= square <= LEAST_FOCAL**-2:
            continue
        square = _polish_root(constraints, square, lu)
        if not square > 0.0:
            continue
        focal = 1.0 / math.sqrt(square)
        _determinant(constraints, 1.0, square, lu)
        _null_vector(lu, v)
        if _essential_of(basis, v[X], v[Y], focal, essentials[found]):
            focals[found] = focal
            found += 1
    return found


@kernel
def _constraint_polynomial(basis, constraints, w):
    """C0, C1, C2 (3 x 10 x 10): (C0 + q C1 + q^2 C2) (x3 ... 1)^T = 0 for q = f^-2.

    With E = D F D, D = diag(1, 1, f^-1), row (i, j) of the constraints is D_ii D_jj times a polynomial of degree two
    in q, and det E is q det F. Three values of q give it.
    """
    e, quadratics, system = w
    for n in range(3):
        depth = 0.5 * 2.0**n
        for i in range(3):
            for j in range(3):
                k = 3 * i + j
                scale = (depth if i == 2 else 1.0) * (depth if j == 2 else 1.0)
                for c in range(4):
                    e[k, c] = 0.0 if c == 2 else scale * basis[min(c, 2), k]
        essential_constraints(e, quadratics, system)
        for r in range(10):
            scale = depth * depth
            if r > 0:
                scale = (depth if r > 6 else 1.0) * (depth if r % 3 == 0 else 1.0)
            for c in range(10):
                constraints[n, r, c] = system[r, WITHOUT_Z[c]] / scale
    for r in range(10):
        for c in range(10):
            # Newton's divided differences at q = 1/4, 1, 4.
            low, middle, high = constraints[0, r, c], constraints[1, r, c], constraints[2, r, c]
            first, second = (middle - low) / 0.75, (high - middle) / 3.0
            bend = (second - first) / 3.75
            constraints[0, r, c] = low - 0.25 * first + 0.25 * bend
            constraints[1, r, c] = first - 1.25 * bend
            constraints[2, r, c] = bend


@kernel
def _determinant_polynomial(constraints, lu, values, poly):
    """The determinant as a polynomial in u, where f^-2 = m (1 + u) / (1 - u), times (1 - u)^15; returns m.

    All focal lengths have -1 < u < 1. With m the geometric mean of the roots' magnitudes, the polynomial is equally large at both
    ends; otherwise it would vary by twenty orders of magnitude.
    """
    far = _determinant(constraints, 1.0, FAR, lu)
    if far == 0.0:
        far = math.inf
    mean = (abs(_determinant(constraints, 1.0, 0.0, lu) / far) * FAR**DEGREE) ** (1.0 / DEGREE)
    for k in range(DEGREE + 1):
        # The ten equations are of degree two in f^-2: of the 20 factors 1 - u, 15 belong to the polynomial.
        below = 1.0 - NODES[k]
        values[k] = _determinant(constraints, below, mean * (1.0 + NODES[k]), lu) / below**5
    for k in range(DEGREE + 1):
        poly[k] = 0.0
        for n in range(DEGREE + 1):
            poly[k] += TO_COEFFICIENTS[k, n] * values[n]
    return mean


@kernel
def _determinant(constraints, p, q, lu):
    """Det (p^2 C0 + p q C1 + q^2 C2); `lu` receives the triangular factors, q / p is f^-2."""
    a, b, c = p * p, p * q, q * q
    for i in range(10):
        for j in range(10):
            lu[i, j] = a * constraints[0, i, j] + b * constraints[1, i, j] + c * constraints[2, i, j]
    determinant = 1.0
    for k in range(10):
        best = k
        for r in range(k + 1, 10):
            if abs(lu[r, k]) > abs(lu[best, k]):
                best = r
        if best != k:
            determinant = -determinant
            for n in range(k, 10):
                lu[k, n], lu[best, n] = lu[best, n], lu[k, n]
        pivot = lu[k, k]
        determinant *= pivot
        if pivot == 0.0:
            return 0.0
        pivot = 1.0 / pivot
        for r in range(k + 1, 10):
            factor = lu[r, k] * pivot
            for n in range(k + 1, 10):
                lu[r, n] -= factor * lu[k, n]
    return determinant


@kernel
def _polish_root(constraints, q, lu):
    """The root of the determinant close to q, by the secant method."""
    step = 1e-8 * q
    at = _determinant(constraints, 1.0, q, lu)
    for _ in range(6):
        there = _determinant(constraints, 1.0, q + step, lu)
        if there == at:
            break
        q, at, step = q + step, there, -there * step / (there - at)
        if not abs(step) > 1e-15 * q:
            break
    return q


@kernel
def _null_vector(lu, v):
    """The null vector of the (nearly singular) upper triangle of `lu`, with v[9] = 1."""
    v[9] = 1.0
    for k in range(8, -1, -1):
        total = 0.0
        for c in range(k + 1, 10):
            total += lu[k, c] * v[c]
        v[k] = -total / lu[k, k]


@kernel
def _essential_of(basis, x, y, focal, out):
    """E = K F K, of unit length."""
    norm = 0.0
    for i in range(3):
        for j in range(3):
            k = 3 * i + j
            scale = (focal if i < 2 else 1.0) * (focal if j < 2 else 1.0)
            out[k] = scale * (x * basis[0, k] + y * basis[1, k] + basis[2, k])
            norm += out[k] * out[k]
    if not (norm > 0.0 and norm < math.inf):
        return False
    norm = 1.0 / math.sqrt(norm)
    for k in range(9):
        out[k] *= norm
    return True


@kernel(allocates=True)
def shared_focal_workspace():
    """Working arrays of `shared_focal_six_point`."""
    return (
        np.empty((6, 9)),
        np.empty((3, 9)),
        np.empty((3, 10, 10)),
        np.empty((10, 10)),
        np.empty(DEGREE + 1),
        np.empty(DEGREE + 1),
        np.empty(DEGREE),
        roots_workspace(),
        np.empty(10),
        (np.empty((9, 4)), np.empty((7, 10)), np.empty((10, 20))),
    )


@kernel
def focals_from_fundamental(f):
    """(f1, f2) of cameras with principal points at zero; NaN if there are none (Bougnoux, ICCV 1998).

    f1^2 = -(p^T [e2]x I F p)(p^T F^T p) / (p^T [e2]x I F I F^T p) with p = (0, 0, 1), I = diag(1, 1, 0); f2 from F^T.
    """
    return _bougnoux(f, False), _bougnoux(f, True)


@kernel
def _entry(f, i, j, transposed):
    return f[3 * j + i] if transposed else f[3 * i + j]


@kernel
def _bougnoux(f, transposed):
    # The left null vector of F: the longest cross product of two columns.
    best, e0, e1 = 0.0, 0.0, 0.0
    for c in range(3):
        d = (c + 1) % 3
        a0, a1, a2 = _entry(f, 0, c, transposed), _entry(f, 1, c, transposed), _entry(f, 2, c, transposed)
        b0, b1, b2 = _entry(f, 0, d, transposed), _entry(f, 1, d, transposed), _entry(f, 2, d, transposed)
        x, y, z = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        size = x * x + y * y + z * z
        if size > best:
            best, e0, e1 = size, x, y
    # p^T [e2]x I = (-e1, e0, 0).
    g0 = -e1 * _entry(f, 0, 0, transposed) + e0 * _entry(f, 1, 0, transposed)
    g1 = -e1 * _entry(f, 0, 1, transposed) + e0 * _entry(f, 1, 1, transposed)
    g2 = -e1 * _entry(f, 0, 2, transposed) + e0 * _entry(f, 1, 2, transposed)
    below = g0 * _entry(f, 2, 0, transposed) + g1 * _entry(f, 2, 1, transposed)
    square = -g2 * _entry(f, 2, 2, transposed) / below if below != 0.0 else -1.0
    return math.sqrt(square) if square > 0.0 else math.nan
