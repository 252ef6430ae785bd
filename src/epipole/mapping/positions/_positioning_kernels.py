"""Global positioning: cost, elimination of distances and points, back-substitution.

For observation k of point j in image i, with the unit direction v in world axes, u = X_j - c_i, inverse distance s and weight w:

    r = v - s u,    dr = -s (dX - dc) - u ds
    ds = (u.r - s u.(dX - dc)) / h,    h = (1 + damping) u.u
    A = w s^2 (I - u u^T / h),    b = w s (r - u (u.r) / h)

ds eliminates first and leaves A (dX - dc) = b; then dX = M^-1 (sum b + sum A dc) with M = sum A, and the system of the centers:

    sum_k A_k - A_k M^-1 A_l  of images k, l,    right side  A_k M^-1 (sum b) - b_k

Near the solution, each point is refined alone after each step of the centers (variable projection: Golub and Pereyra,
1973). Otherwise a few points that fit badly would make the steps of all centers short. Far from it, points must be able to pass
through the cameras, which the linear step of the inverse distances allows.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel

LEAST_INVERSE_DISTANCE = 1e-5
REFINING_STEPS, REFINING_TRIES, SMALL_REFINEMENT = 2, 3, 1e-3
SMALLEST = 1e-9  # relative damping of a point that its observations leave undetermined


class Directions(NamedTuple):
    """Unit directions in world axes, grouped by point."""

    offsets: np.ndarray  # (t + 1,) int64
    image: np.ndarray  # (r,) int64
    direction: np.ndarray  # (r, 3)


class Eliminated(NamedTuple):
    """What back-substitution needs again."""

    normal: np.ndarray  # (r, 6) lower triangle of A by rows
    right: np.ndarray  # (r, 3) b
    factor: np.ndarray  # (t, 6) lower triangle of the Cholesky factor of M by rows
    sum_right: np.ndarray  # (t, 3)


@kernel
def robust_cost(seen, centers, points, inverse, scale, weight):
    """Huber's loss of all residuals; writes the weight of each."""
    cost = 0.0
    for j in range(len(points)):
        for k in range(seen.offsets[j], seen.offsets[j + 1]):
            norm = _residual(centers[seen.image[k]], points[j], seen.direction[k], inverse[k])
            weight[k] = 1.0 if norm <= scale else scale / norm
            cost += _huber(norm, scale)
    return cost


@kernel
def _residual(c, x, v, s):
    r0 = v[0] - s * (x[0] - c[0])
    r1 = v[1] - s * (x[1] - c[1])
    r2 = v[2] - s * (x[2] - c[2])
    return math.sqrt(r0 * r0 + r1 * r1 + r2 * r2)


@kernel
def _huber(norm, scale):
    return norm * norm if norm <= scale else 2.0 * scale * norm - scale * scale


@kernel
def _best_inverse(c, x, v):
    """The inverse distance with the smallest residual."""
    u0, u1, u2 = x[0] - c[0], x[1] - c[1], x[2] - c[2]
    squared = u0 * u0 + u1 * u1 + u2 * u2 + 1e-300
    return max((u0 * v[0] + u1 * v[1] + u2 * v[2]) / squared, LEAST_INVERSE_DISTANCE)


@kernel
def _eliminate_distance(c, x, v, s, w, damping, normal, right):
    """A and b of one observation."""
    u0, u1, u2 = x[0] - c[0], x[1] - c[1], x[2] - c[2]
    r0, r1, r2 = v[0] - s * u0, v[1] - s * u1, v[2] - s * u2
    h = (u0 * u0 + u1 * u1 + u2 * u2) * (1.0 + damping) + 1e-300
    a, f = w * s * s, w * s * s / h
    normal[0], normal[1], normal[2] = a - f * u0 * u0, -f * u1 * u0, a - f * u1 * u1
    normal[3], normal[4], normal[5] = -f * u2 * u0, -f * u2 * u1, a - f * u2 * u2
    along = (u0 * r0 + u1 * r1 + u2 * r2) / h
    right[0] = w * s * (r0 - along * u0)
    right[1] = w * s * (r1 - along * u1)
    right[2] = w * s * (r2 - along * u2)


@kernel
def _factor_point(seen, j, damping, kept):
    """Cholesky factor of the damped M of point j, and its right side."""
    f, h = kept.factor[j], kept.sum_right[j]
    for p in range(6):
        f[p] = 0.0
    for p in range(3):
        h[p] = 0.0
    for k in range(seen.offsets[j], seen.offsets[j + 1]):
        for p in range(6):
            f[p] += kept.normal[k, p]
        for p in range(3):
            h[p] += kept.right[k, p]
    least = SMALLEST * (f[0] + f[2] + f[5]) + 1e-300
    m00, m11, m22 = (
        (1.0 + damping) * f[0] + least,
        (1.0 + damping) * f[2] + least,
        (1.0 + damping) * f[5] + least,
    )
    f[0] = math.sqrt(m00)
    f[1] = f[1] / f[0]
    f[3] = f[3] / f[0]
    f[2] = math.sqrt(max(m11 - f[1] * f[1], least))
    f[4] = (f[4] - f[3] * f[1]) / f[2]
    f[5] = math.sqrt(max(m22 - f[3] * f[3] - f[4] * f[4], least))


@kernel
def _forward(f, b0, b1, b2):
    """L^-1 b."""
    y0 = b0 / f[0]
    y1 = (b1 - f[1] * y0) / f[2]
    return y0, y1, (b2 - f[3] * y0 - f[4] * y1) / f[5]


@kernel
def _backward(f, y0, y1, y2):
    """L^-T y."""
    d2 = y2 / f[5]
    d1 = (y1 - f[4] * d2) / f[2]
    return (y0 - f[1] * d1 - f[3] * d2) / f[0], d1, d2


@kernel
def find_blocks(seen, row_start, column, block_of_pair):
    """The block of each pair of observations of a point, in the order of `reduce_points`; returns the number of pairs.

    The blocks are those of a lower triangle, by rows, with sorted columns. With an empty `block_of_pair`, the pairs are only counted.
    """
    count = np.int64(0)
    for j in range(len(seen.offsets) - 1):
        for k in range(seen.offsets[j], seen.offsets[j + 1]):
            for other in range(seen.offsets[j], seen.offsets[j + 1]):
                if seen.image[other] <= seen.image[k]:
                    if len(block_of_pair) > 0:
                        block_of_pair[count] = _block_at(row_start, column, seen.image[k], seen.image[other])
                    count += 1
    return count


@kernel
def reduce_points(
    seen, centers, points, inverse, weight, damping, kept, diagonal, block_of_pair, blocks, gradient, half
):
    """Add the system of the centers: blocks of its lower triangle and its right side.

    `diagonal` has the block of each image, `block_of_pair` those of `find_blocks`; `half` (longest track, 3, 3) is scratch.
    """
    at = 0
    for j in range(len(points)):
        first, last = seen.offsets[j], seen.offsets[j + 1]
        for k in range(first, last):
            _eliminate_distance(
                centers[seen.image[k]],
                points[j],
                seen.direction[k],
                inverse[k],
                weight[k],
                damping,
                kept.normal[k],
                kept.right[k],
            )
        _factor_point(seen, j, damping, kept)
        f, h = kept.factor[j], kept.sum_right[j]
        y0, y1, y2 = _forward(f, h[0], h[1], h[2])
        for k in range(first, last):
            a, z, g = kept.normal[k], half[k - first], gradient[seen.image[k]]
            z[0, 0], z[1, 0], z[2, 0] = _forward(f, a[0], a[1], a[3])
            z[0, 1], z[1, 1], z[2, 1] = _forward(f, a[1], a[2], a[4])
            z[0, 2], z[1, 2], z[2, 2] = _forward(f, a[3], a[4], a[5])
            for p in range(3):
                g[p] += z[0, p] * y0 + z[1, p] * y1 + z[2, p] * y2 - kept.right[k, p]
        for k in range(first, last):
            for other in range(first, last):
                if seen.image[other] <= seen.image[k]:
                    block = blocks[block_of_pair[at]]
                    at += 1
                    z, y = half[k - first], half[other - first]
                    for p in range(3):
                        for q in range(3):
                            block[p, q] -= z[0, p] * y[0, q] + z[1, p] * y[1, q] + z[2, p] * y[2, q]
            _add_symmetric(blocks[diagonal[seen.image[k]]], kept.normal[k])


@kernel
def _block_at(row_start, column, i, j):
    low, high = row_start[i], row_start[i + 1]
    while high - low > 1:
        middle = (low + high) // 2
        if column[middle] <= j:
            low = middle
        else:
            high = middle
    return low


@kernel
def _add_symmetric(block, a):
    block[0, 0] += a[0]
    block[1, 0] += a[1]
    block[0, 1] += a[1]
    block[1, 1] += a[2]
    block[2, 0] += a[3]
    block[0, 2] += a[3]
    block[2, 1] += a[4]
    block[1, 2] += a[4]
    block[2, 2] += a[5]


@kernel
def substitute_back(seen, centers, points, inverse, damping, step, kept, moved, moved_inverse):
    """Points and inverse distances after the step (n, 3) of the centers; inverse distances stay positive."""
    for j in range(len(points)):
        t0, t1, t2 = kept.sum_right[j, 0], kept.sum_right[j, 1], kept.sum_right[j, 2]
        for k in range(seen.offsets[j], seen.offsets[j + 1]):
            a, e = kept.normal[k], step[seen.image[k]]
            t0 += a[0] * e[0] + a[1] * e[1] + a[3] * e[2]
            t1 += a[1] * e[0] + a[2] * e[1] + a[4] * e[2]
            t2 += a[3] * e[0] + a[4] * e[1] + a[5] * e[2]
        f = kept.factor[j]
        y0, y1, y2 = _forward(f, t0, t1, t2)
        d0, d1, d2 = _backward(f, y0, y1, y2)
        moved[j, 0], moved[j, 1], moved[j, 2] = points[j, 0] + d0, points[j, 1] + d1, points[j, 2] + d2
        for k in range(seen.offsets[j], seen.offsets[j + 1]):
            c, e, v, s = centers[seen.image[k]], step[seen.image[k]], seen.direction[k], inverse[k]
            u0, u1, u2 = points[j, 0] - c[0], points[j, 1] - c[1], points[j, 2] - c[2]
            squared = u0 * u0 + u1 * u1 + u2 * u2
            toward = u0 * v[0] + u1 * v[1] + u2 * v[2] - s * squared
            change = u0 * (d0 - e[0]) + u1 * (d1 - e[1]) + u2 * (d2 - e[2])
            s += (toward - s * change) / (squared * (1.0 + damping) + 1e-300)
            moved_inverse[k] = max(s, LEAST_INVERSE_DISTANCE)


@kernel
def refine_points(seen, centers, points, inverse, scale, kept, moved):
    """Lower the cost of each point with the centers fixed, in a few steps; `moved` (3,) is scratch."""
    for j in range(len(points)):
        cost = _cost_of_point(seen, j, centers, points[j], scale)
        for _ in range(REFINING_STEPS):
            d0, d1, d2 = _step_of_point(seen, j, centers, points[j], scale, kept)
            length, after = 1.0, cost
            for _ in range(REFINING_TRIES):
                moved[0], moved[1], moved[2] = (
                    points[j, 0] + length * d0,
                    points[j, 1] + length * d1,
                    points[j, 2] + length * d2,
                )
                after = _cost_of_point(seen, j, centers, moved, scale)
                if after < cost:
                    break
                length *= 0.25
            if not after < cost:
                break
            gain, cost = cost - after, after
            points[j, 0], points[j, 1], points[j, 2] = moved[0], moved[1], moved[2]
            if gain < SMALL_REFINEMENT * cost:
                break
        for k in range(seen.offsets[j], seen.offsets[j + 1]):
            inverse[k] = _best_inverse(centers[seen.image[k]], points[j], seen.direction[k])


@kernel
def _cost_of_point(seen, j, centers, x, scale):
    """Its cost with the best inverse distances."""
    cost = 0.0
    for k in range(seen.offsets[j], seen.offsets[j + 1]):
        c, v = centers[seen.image[k]], seen.direction[k]
        cost += _huber(_residual(c, x, v, _best_inverse(c, x, v)), scale)
    return cost


@kernel
def _step_of_point(seen, j, centers, x, scale, kept):
    """Gauss-Newton's step M^-1 sum b."""
    for k in range(seen.offsets[j], seen.offsets[j + 1]):
        c, v = centers[seen.image[k]], seen.direction[k]
        s = _best_inverse(c, x, v)
        norm = _residual(c, x, v, s)
        weight = 1.0 if norm <= scale else scale / norm
        _eliminate_distance(c, x, v, s, weight, 0.0, kept.normal[k], kept.right[k])
    _factor_point(seen, j, 0.0, kept)
    f, h = kept.factor[j], kept.sum_right[j]
    y0, y1, y2 = _forward(f, h[0], h[1], h[2])
    return _backward(f, y0, y1, y2)
