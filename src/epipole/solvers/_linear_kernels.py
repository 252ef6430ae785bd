"""Small dense linear algebra and real roots for the minimal solvers; no allocation, no LAPACK."""

import math

import numpy as np

from epipole._jit import kernel


@kernel
def solve_spd(a, b, n):
    """Solve a x = b for symmetric positive definite a (n x n) by Cholesky, in place; False if not definite."""
    for j in range(n):
        for k in range(j):
            a[j, j] -= a[j, k] * a[j, k]
        if not a[j, j] > 1e-300:
            return False
        a[j, j] = math.sqrt(a[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            a[i, j] /= a[j, j]
    for i in range(n):
        for k in range(i):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= a[k, i] * b[k]
        b[i] /= a[i, i]
    return True


@kernel
def reduce_rows(a):
    """Gauss-Jordan with row pivoting: a -> [I | B], in place; False where a pivot vanishes."""
    rows, cols = a.shape
    for j in range(rows):
        best = j
        for i in range(j + 1, rows):
            if abs(a[i, j]) > abs(a[best, j]):
                best = i
        if not abs(a[best, j]) > 1e-14:
            return False
        if best != j:
            for c in range(j, cols):
                a[j, c], a[best, c] = a[best, c], a[j, c]
        scale = 1.0 / a[j, j]
        for c in range(j, cols):
            a[j, c] *= scale
        for i in range(rows):
            if i != j:
                factor = a[i, j]
                if factor != 0.0:
                    for c in range(j, cols):
                        a[i, c] -= factor * a[j, c]
    return True


@kernel
def null_space(a, basis):
    """Orthonormal basis (cols - rows vectors in basis' rows) of the null space of a (rows x cols).

    Householder QR of a^T, in place: the last columns of Q span the complement of a's rows.
    """
    rows, cols = a.shape
    for j in range(rows):
        norm = 0.0
        for c in range(j, cols):
            norm += a[j, c] * a[j, c]
        norm = math.sqrt(norm)
        if norm == 0.0:
            continue
        alpha = -norm if a[j, j] > 0 else norm
        a[j, j] -= alpha
        size = 0.0
        for c in range(j, cols):
            size += a[j, c] * a[j, c]
        if size == 0.0:
            continue
        size = math.sqrt(2.0 / size)
        for c in range(j, cols):
            a[j, c] *= size  # now I - v v^T reflects
        for i in range(j + 1, rows):
            dot = 0.0
            for c in range(j, cols):
                dot += a[i, c] * a[j, c]
            for c in range(j, cols):
                a[i, c] -= dot * a[j, c]
    for m in range(cols - rows):
        for c in range(cols):
            basis[m, c] = 0.0
        basis[m, rows + m] = 1.0
        for j in range(rows - 1, -1, -1):
            dot = 0.0
            for c in range(j, cols):
                dot += basis[m, c] * a[j, c]
            for c in range(j, cols):
                basis[m, c] -= dot * a[j, c]


@kernel
def symmetric_eigen(a, vectors):
    """Jacobi's method: a (n x n, symmetric) becomes diagonal, columns of vectors its eigenvectors (unsorted)."""
    n = len(a)
    for i in range(n):
        for j in range(n):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off, diagonal = 0.0, 0.0
        for i in range(n):
            diagonal += a[i, i] * a[i, i]
            for j in range(i):
                off += a[i, j] * a[i, j]
        if off <= 1e-30 * diagonal:
            return
        for p in range(n - 1):
            for q in range(p + 1, n):
                if a[p, q] == 0.0:
                    continue
                theta = 0.5 * (a[q, q] - a[p, p]) / a[p, q]
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(n):
                    akp, akq = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * akp - s * akq, s * akp + c * akq
                for k in range(n):
                    apk, aqk = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * apk - s * aqk, s * apk + c * aqk
                for k in range(n):
                    vkp, vkq = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * vkp - s * vkq, s * vkp + c * vkq


@kernel
def _polish(poly, degree, low, high, f_low):
    """The root of poly between low and high, where it changes sign: Newton's method kept inside the bracket."""
    x = 0.5 * (low + high)
    for _ in range(60):
        value, slope = poly[degree], 0.0
        for k in range(degree - 1, -1, -1):
            slope = slope * x + value
            value = value * x + poly[k]
        if (value > 0.0) == (f_low > 0.0):
            low = x
        else:
            high = x
        step = value / slope if slope != 0.0 else math.inf
        after = x - step
        if not (low < after < high):
            after = 0.5 * (low + high)
        if abs(after - x) <= 1e-15 * (1.0 + abs(after)):
            return after
        x = after
    return x


@kernel
def roots_in_unit_interval(poly, degree, work, roots):
    """Real roots of poly (ascending coefficients) in [-1, 1], ascending; returns their number.

    Between neighbouring roots of the derivative a polynomial is monotone, so the roots of the derivatives,
    from the linear one upward, bracket those of the next (work: (2, degree + 2) and (degree + 1, degree + 1)).
    """
    derivatives, critical = work[0], work[1]
    for k in range(degree + 1):
        derivatives[degree, k] = poly[k]
    for d in range(degree - 1, 0, -1):
        for k in range(d + 1):
            derivatives[d, k] = derivatives[d + 1, k + 1] * (k + 1)
    count = 0
    for d in range(1, degree + 1):
        for k in range(count):
            critical[0, k + 1] = roots[k]
        critical[0, 0], critical[0, count + 1] = -1.0, 1.0
        intervals, found = count + 1, 0
        f_low = _horner(derivatives[d], d, -1.0)
        for k in range(intervals):
            low, high = critical[0, k], critical[0, k + 1]
            f_high = _horner(derivatives[d], d, high)
            if f_low == 0.0:
                roots[found] = low
                found += 1
            elif (f_low > 0.0) != (f_high > 0.0) and f_high != 0.0:
                roots[found] = _polish(derivatives[d], d, low, high, f_low)
                found += 1
            f_low = f_high
        if f_low == 0.0 and found < d:
            roots[found] = 1.0
            found += 1
        count = found
    return count


@kernel
def _horner(poly, degree, x):
    value = poly[degree]
    for k in range(degree - 1, -1, -1):
        value = value * x + poly[k]
    return value


@kernel
def real_roots(poly, work, roots):
    """All real roots of poly (ascending coefficients); returns their number.

    Roots beyond 1 in size are the inverses of those of the reversed polynomial inside the interval.
    """
    degree = len(poly) - 1
    biggest = 0.0
    for k in range(degree + 1):
        biggest = max(biggest, abs(poly[k]))
    if not (biggest > 0.0 and biggest < np.inf):
        return 0
    count = roots_in_unit_interval(poly, degree, work, roots)
    reversed_poly, inverse = work[2, 0], work[2, 1]
    for k in range(degree + 1):
        reversed_poly[k] = poly[degree - k]
    more = roots_in_unit_interval(reversed_poly, degree, work, inverse)
    for k in range(more):
        if abs(inverse[k]) > 1e-12 and abs(inverse[k]) < 1.0 and count < degree:
            roots[count] = 1.0 / inverse[k]
            count += 1
    return count
