"""Relative pose of cameras with unknown focal lengths: one for both (six points), or one each (seven points)."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.solvers._linear_kernels import null_space
from epipole.solvers._two_view_kernels import essential_constraints

LEAST_FOCAL, MOST_FOCAL, GRID, DIP_STEPS = 0.25, 8.0, 48, 6
# Columns of the 20 monomials of the essential constraints that hold no z: x3 y3 x2y xy2 x2 y2 xy x y 1.
WITHOUT_Z = np.array([0, 1, 2, 3, 5, 7, 9, 12, 15, 19])
X, Y = 7, 8  # where x and y stand among them


@kernel
def _constraint_matrix(basis, focal, w):
    """C(f) (10 x 10) with C (x3 ... 1)^T = 0 for E = K (x F1 + y F2 + F3) K, K = diag(1, 1, 1 / f) up to scale.

    Returns its determinant; afterwards `lu` holds its triangular factors and `pivots` the order of the rows.
    """
    e, quadratics, system, lu, pivots = w
    for i in range(3):
        for j in range(3):
            scale = (focal if i < 2 else 1.0) * (focal if j < 2 else 1.0) / (focal * focal)
            k = 3 * i + j
            e[k, 0], e[k, 1], e[k, 2], e[k, 3] = (
                basis[0, k] * scale,
                basis[1, k] * scale,
                0.0,
                basis[2, k] * scale,
            )
    essential_constraints(e, quadratics, system)
    for r in range(10):
        for c in range(10):
            lu[r, c] = system[r, WITHOUT_Z[c]]
        pivots[r] = r
    determinant = 1.0
    for k in range(10):
        best = k
        for r in range(k + 1, 10):
            if abs(lu[r, k]) > abs(lu[best, k]):
                best = r
        if best != k:
            determinant = -determinant
            for c in range(10):
                lu[k, c], lu[best, c] = lu[best, c], lu[k, c]
        determinant *= lu[k, k]
        if lu[k, k] == 0.0:
            return 0.0
        for r in range(k + 1, 10):
            factor = lu[r, k] / lu[k, k]
            for c in range(k + 1, 10):
                lu[r, c] -= factor * lu[k, c]
    return determinant


@kernel
def _null_vector(lu, v):
    """The vector that the (nearly singular) upper triangle of `lu` sends to zero, with v[9] = 1."""
    v[9] = 1.0
    for k in range(8, -1, -1):
        total = 0.0
        for c in range(k + 1, 10):
            total += lu[k, c] * v[c]
        v[k] = -total / lu[k, k]


@kernel
def shared_focal_six_point(x1, x2, essentials, focals, w):
    """E (k, 9) and f (k,) of two cameras with one focal length, from six matches (rows (u, v, 1), pixels of order one).

    x2^T F x1 = 0 leaves F = x F1 + y F2 + F3; for a focal length the constraints of the essential matrix are ten equations
    in the ten monomials of x and y, whose determinant vanishes at the true one (Stewenius et al. 2005; Kukelova,
    Bujnak and Pajdla, BMVC 2008). Its sign is followed over focal lengths from a quarter to eight units, for
    no other is a lens. Assumption: square pixels, no distortion, principal points at zero. Returns k, at most 8.
    """
    a, basis, v, matrix = w
    for k in range(6):
        for i in range(3):
            for j in range(3):
                a[k, 3 * i + j] = x2[k, i] * x1[k, j]
    null_space(a, basis)
    found, step = 0, math.log(MOST_FOCAL / LEAST_FOCAL) / GRID
    first, low = 0.0, LEAST_FOCAL
    before, below = 0.0, _constraint_matrix(basis, low, matrix)
    for n in range(1, GRID + 1):
        high = LEAST_FOCAL * math.exp(step * n)
        above = _constraint_matrix(basis, high, matrix)
        if below * above < 0.0:
            found = _add_root(basis, low, high, below, above, matrix, v, essentials, focals, found)
        elif n > 1 and before * below > 0.0 and abs(below) < abs(before) and abs(below) < abs(above):
            found = _search_dip(
                basis, first, low, high, before, below, above, matrix, v, essentials, focals, found
            )
        first, before = low, below
        low, below = high, above
    return found


@kernel
def _search_dip(basis, first, low, high, before, below, above, matrix, v, essentials, focals, found):
    """A dip towards zero between grid points may hide two roots: follow parabolas to its lowest point."""
    for _ in range(DIP_STEPS):
        # The lowest point of the parabola through three unequally spaced points.
        p, q = (low - first) * (below - above), (low - high) * (below - before)
        if p == q:
            return found
        dip = low - 0.5 * ((low - first) * p - (low - high) * q) / (p - q)
        if not (dip > first and dip < high) or abs(dip - low) < 1e-9 * low:
            return found
        value = _constraint_matrix(basis, dip, matrix)
        if value * below < 0.0:
            if dip > low:
                first, before = low, below
            else:
                high, above = low, below
            found = _add_root(basis, first, dip, before, value, matrix, v, essentials, focals, found)
            return _add_root(basis, dip, high, value, above, matrix, v, essentials, focals, found)
        if abs(value) < abs(below):
            if dip > low:
                first, before = low, below
            else:
                high, above = low, below
            low, below = dip, value
        elif dip > low:
            high, above = dip, value
        else:
            first, before = dip, value
    return found


@kernel
def _add_root(basis, low, high, below, above, matrix, v, essentials, focals, found):
    """Append the solution at the root between two focal lengths, if there is room; returns their number."""
    if found == len(focals):
        return found
    focal = _root_between(basis, low, high, below, above, matrix)
    _constraint_matrix(basis, focal, matrix)
    _null_vector(matrix[3], v)
    if _essential_of(basis, v[X], v[Y], focal, essentials[found]):
        focals[found] = focal
        found += 1
    return found


@kernel
def _root_between(basis, low, high, below, above, matrix):
    """The focal length where the determinant vanishes, by the Illinois rule (Dowell and Jarratt 1971)."""
    for _ in range(40):
        middle = (low * above - high * below) / (above - below)
        value = _constraint_matrix(basis, middle, matrix)
        if value == 0.0 or abs(high - low) < 1e-10 * high:
            return middle
        if value * above < 0.0:
            low, below = high, above
        else:
            below *= 0.5
        if abs(middle - high) < 1e-11 * high:
            return middle
        high, above = middle, value
    return high


@kernel
def _essential_of(basis, x, y, focal, out):
    """E = K F K, of length one."""
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
    """Arrays that `shared_focal_six_point` writes into."""
    matrix = (
        np.empty((9, 4)),
        np.empty((7, 10)),
        np.empty((10, 20)),
        np.empty((10, 10)),
        np.empty(10, np.int64),
    )
    return np.empty((6, 9)), np.empty((3, 9)), np.empty(10), matrix


@kernel
def focals_from_fundamental(f):
    """(f1, f2) of cameras with principal points at zero; NaN where none exist (Bougnoux, ICCV 1998).

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
