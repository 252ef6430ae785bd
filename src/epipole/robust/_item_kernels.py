"""Shared by the robust problems: sums over blocks of items, Sampson distance, chain rule, rotation."""

import math

import numpy as np

from epipole._jit import kernel

BLOCK, MOST_NEAR = 128, 512
# `reassoc` lets sums over a block vectorize (4 times faster, measured). It is only for loops that read: of a loop that writes, LLVM
# keeps a version for arrays that overlap, and chooses it by their distance in memory, which would change the order of the sum.
REASSOC = frozenset({"reassoc"})


@kernel(extra_fastmath=REASSOC)
def dot_rows(a, b, count):
    """Dot product of the first `count` numbers."""
    total = 0.0
    for k in range(count):
        total += a[k] * b[k]
    return total


@kernel(extra_fastmath=REASSOC)
def sum_row(a, count):
    """Sum of the first `count` numbers."""
    total = 0.0
    for k in range(count):
        total += a[k]
    return total


@kernel
def _combine(d, rows, count, out):
    """Out = sum_i d_i rows[1 + i], the chain rule from the entries of a matrix to a parameter."""
    d0, d1, d2, d3, d4, d5, d6, d7, d8 = d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7], d[8]
    for k in range(count):
        out[k] = (
            d0 * rows[1, k]
            + d1 * rows[2, k]
            + d2 * rows[3, k]
            + d3 * rows[4, k]
            + d4 * rows[5, k]
            + d5 * rows[6, k]
            + d6 * rows[7, k]
            + d7 * rows[8, k]
            + d8 * rows[9, k]
        )


@kernel
def add_normal_equations(d, rows, jac, count, a, b):
    """A += J^T J (lower), b += J^T r of a block whose derivatives by matrix entries are in rows[1:10]."""
    size = len(d)
    for i in range(size):
        _combine(d[i], rows, count, jac[i])
    for i in range(size):
        b[i] += dot_rows(jac[i], rows[0], count)
        for j in range(i + 1):
            a[i, j] += dot_rows(jac[i], jac[j], count)


@kernel
def rotate_left(phi, r, out):
    """Out = exp(phi) r for rotations row by row (Rodrigues)."""
    angle = math.sqrt(phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2)
    first = 1.0 - angle * angle / 6.0 if angle < 1e-4 else math.sin(angle) / angle
    second = 0.5 - angle * angle / 24.0 if angle < 1e-4 else (1.0 - math.cos(angle)) / (angle * angle)
    x, y, z = phi[0], phi[1], phi[2]
    for j in range(3):
        a, b, c = r[j], r[3 + j], r[6 + j]
        u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
        out[j] = a + first * u + second * (y * w - z * v)
        out[3 + j] = b + first * v + second * (z * u - x * w)
        out[6 + j] = c + first * w + second * (x * v - y * u)


@kernel
def gather(matches, sample, x1, x2):
    """Rows (x, y, 1) of the sampled matches."""
    for k in range(len(x1)):
        x1[k, 0], x1[k, 1], x1[k, 2] = matches[0, sample[k]], matches[1, sample[k]], 1.0
        x2[k, 0], x2[k, 1], x2[k, 2] = matches[2, sample[k]], matches[3, sample[k]], 1.0


@kernel(allocates=True)
def columns_within(items, residuals, threshold_sq):
    """The columns of `items` with residuals within the threshold, at most the first MOST_NEAR.

    Items come in random order, so this sample is as good for local optimization as all of them.
    """
    count, last = 0, len(residuals)
    for k in range(len(residuals)):
        if residuals[k] < threshold_sq:
            count += 1
            if count == MOST_NEAR:
                last = k + 1
                break
    out = np.empty((items.shape[0], count))
    for i in range(items.shape[0]):
        position = 0
        for k in range(last):
            if residuals[k] < threshold_sq:
                out[i, position] = items[i, k]
                position += 1
    return out


@kernel(fuse=True)
def nine(model, start):
    """Nine numbers of a model as a tuple, which loops can keep in registers."""
    f = model[start : start + 9]
    return f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]


@kernel(fuse=True)
def sampson(f, m, k):
    """(e, s, F x1, F^T x2) of match k: the squared Sampson distance is r^2 = e^2 / s (Sampson 1982; HZ eq. 11.9).

    e = x2^T F x1, s = |(F x1)_12|^2 + |(F^T x2)_12|^2; f is a tuple, F row by row.
    """
    a, b, c, d = m[0, k], m[1, k], m[2, k], m[3, k]
    l0, l1, l2 = f[0] * a + f[1] * b + f[2], f[3] * a + f[4] * b + f[5], f[6] * a + f[7] * b + f[8]
    g0, g1 = f[0] * c + f[3] * d + f[6], f[1] * c + f[4] * d + f[7]
    e = c * l0 + d * l1 + l2
    return e, l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300, (l0, l1, l2), (g0, g1)


@kernel(fuse=True)
def sampson_row(m, k, e, inverse, root, line, back):
    """The residual of match k times `root`, and its derivatives by the entries of F: a tuple for ten rows.

    dr / dF_ij = (x2_i x1_j - (e / s) ([i < 2] (F x1)_i x1_j + [j < 2] (F^T x2)_j x2_i)) / sqrt(s); inverse = 1 / s. `root`
    is sqrt(weight / s), zero for ignored items. The caller writes the rows: a loop that calls a function which writes to an
    array does not vectorize (2.6 times slower).
    """
    a, b, c, d = m[0, k], m[1, k], m[2, k], m[3, k]
    ratio = e * inverse
    u, v = c - ratio * line[0], d - ratio * line[1]
    h0, h1 = ratio * back[0], ratio * back[1]
    first = (root * (u * a - h0 * c), root * (u * b - h1 * c), root * u)
    second = (root * (v * a - h0 * d), root * (v * b - h1 * d), root * v)
    return root * e, first, second, (root * (a - h0), root * (b - h1), root)


@kernel(extra_fastmath=REASSOC)
def sampson_agreeing(matrix, m, threshold_sq, start, stop):
    """Number of matches start..stop with a squared Sampson distance below the threshold."""
    f, count = nine(matrix, 0), 0
    for k in range(start, stop):
        e, s, _, _ = sampson(f, m, k)
        count += 1 if e * e < threshold_sq * s else 0
    return count


@kernel
def median(values, count):
    """The median of the first `count` numbers, which are reordered (Hoare's selection, 1961)."""
    low, high, middle = 0, count - 1, count // 2
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            break
    return values[middle]
