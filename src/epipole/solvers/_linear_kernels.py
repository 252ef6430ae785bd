"""Small dense linear algebra for the minimal solvers; no allocation, no LAPACK."""

import math

from epipole._jit import kernel


@kernel
def copy_numbers(source, target):
    """Copy source to the front of target; `target[:] = source` takes Numba half a second to compile."""
    for k in range(len(source)):
        target[k] = source[k]


@kernel
def clear(numbers):
    """Set to zero; `numbers[:] = 0` takes ten times as long to compile."""
    for k in range(len(numbers)):
        numbers[k] = 0.0


@kernel
def clear_rows(matrix):
    """Set a matrix to zero."""
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            matrix[i, j] = 0.0


@kernel
def solve_spd(a, b, n):
    """Solve a x = b for symmetric positive definite a (n x n) by Cholesky, in place; False if it is not definite."""
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
    """Gauss-Jordan with row pivoting: a -> [I | B], in place; False if a pivot vanishes."""
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
            a[j, c] *= size  # now I - v v^T is the reflection
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
