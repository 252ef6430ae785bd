"""The reduced system of bundle adjustment: assembly, products, back-substitution; equations in `_bundle_kernels`."""

from epipole._jit import kernel
from epipole._simd_kernels import (
    add_product,
    add_rows,
    subtract_product,
)


@kernel
def reduce_rows(start, stop, entries, z, row_start, column, blocks, slot, lanes):
    """Subtract Z Z^T from the blocks of rows start..stop of the lower triangle.

    Rows go in groups of len(slot), so that Z of a point is read once for all rows of a group; slot (rows, nodes) must be filled with -1.
    """
    for low in range(start, stop, len(slot)):
        high = min(low + len(slot), stop)
        for a in range(low, high):
            for b in range(row_start[a], row_start[a + 1]):
                slot[a - low, column[b]] = b
        for a in range(low, high):
            for at in range(entries.node_start[a], entries.node_start[a + 1]):
                _reduce_point(
                    entries.point[entries.by_node[at]], low, a, high, entries, z, blocks, slot, lanes
                )
        for a in range(low, high):
            for b in range(row_start[a], row_start[a + 1]):
                slot[a - low, column[b]] = -1


@kernel(fuse=True)
def _reduce_point(j, low, first, high, entries, z, blocks, slot, lanes):
    """Subtract the products of point j from rows low..high; nothing if a row before `first` has done so."""
    for e in range(entries.start[j], entries.start[j + 1]):
        if low <= entries.node[e] < first:
            return
    for e in range(entries.start[j], entries.start[j + 1]):
        row = entries.node[e]
        if row < first or row >= high:
            continue
        own, target = z[e], slot[row - low]
        for other in range(entries.start[j], entries.start[j + 1]):
            block = target[entries.node[other]]
            if block >= 0:
                subtract_product(blocks[block], own, z[other], entries.width[row], lanes)


@kernel
def add_images(unknowns, normal, gradient, positions, blocks, out, wide):
    """Sum the images' normal matrices into the blocks, and their gradients into out (nodes, lanes).

    `positions` (images, 3, 3) gives the block of each pair of nodes (frame, camera, sensor), -1 for none.
    """
    for i in range(len(normal)):
        count = unknowns.num_free[i]
        shared = unknowns.nodes[i, 1] >= 0
        start, end = (0, 6, 6 + count), (6 if shared else 6 + count, 6 + count, 12 + count)
        for a in range(3):
            node = unknowns.nodes[i, a]
            if node < 0:
                continue
            for p in range(start[a], end[a]):
                out[node, p - start[a]] += gradient[i, p]
            for b in range(3):
                if positions[i, a, b] < 0:
                    continue
                block = blocks[positions[i, a, b]]
                for p in range(start[a], end[a]):
                    for q in range(start[b], end[b]):
                        block[p - start[a], q - start[b]] += normal[i, p, q]


@kernel(fuse=True)
def _gather(entries, j, z, x, lane_sums, lanes):
    """Sum Z_a^T x_a of point j, accumulated per lane first to keep the lanes independent."""
    for c in range(3):
        for q in range(len(lanes)):
            lane_sums[c, q] = 0.0
    for e in range(entries.start[j], entries.start[j + 1]):
        own, source = z[e], x[entries.node[e]]
        for c in range(3):
            add_product(lane_sums[c], own[c], source, lanes)
    t0 = t1 = t2 = 0.0
    for q in range(len(lanes)):
        t0 += lane_sums[0, q]
        t1 += lane_sums[1, q]
        t2 += lane_sums[2, q]
    return t0, t1, t2


@kernel
def substitute_back(entries, start, stop, points, kept, step, damping, moved, sums, lanes):
    """Steps of points start..stop for the step (nodes, lanes); moved = points + steps; sums (3, lanes) is scratch.

    Returns the points' part of the predicted decrease, step^T (D step - g) / 2.
    """
    predicted, fraction = 0.0, damping / (1.0 + damping)
    for j in range(start, stop):
        f, h = kept.factor[j], kept.h[j]
        d0 = d1 = d2 = 0.0
        if f[0] > 0.0:
            t0, t1, t2 = _gather(entries, j, kept.z, step, sums, lanes)
            t0, t1, t2 = t0 + h[0], t1 + h[1], t2 + h[2]
            d2 = -f[5] * t2
            d1 = -f[2] * (t1 + f[4] * d2)
            d0 = -f[0] * (t0 + f[1] * d1 + f[3] * d2)
            l0, l1, l2 = 1.0 / f[0], 1.0 / f[2], 1.0 / f[5]
            v0, v1, v2 = l0 * l0, f[1] * f[1] + l1 * l1, f[3] * f[3] + f[4] * f[4] + l2 * l2
            predicted += 0.5 * fraction * (v0 * d0 * d0 + v1 * d1 * d1 + v2 * d2 * d2)
            predicted += 0.5 * (h[0] * t0 + h[1] * t1 + h[2] * t2)
        moved[j, 0], moved[j, 1], moved[j, 2] = points[j, 0] + d0, points[j, 1] + d1, points[j, 2] + d2
    return predicted


@kernel
def multiply_eliminated(entries, start, stop, z, x, out, sums, lanes):
    """Out += Z (Z^T x) over points start..stop, x and out (nodes, lanes), without forming S; sums is scratch."""
    for j in range(start, stop):
        t0, t1, t2 = _gather(entries, j, z, x, sums, lanes)
        for e in range(entries.start[j], entries.start[j + 1]):
            add_rows(out[entries.node[e]], t0, z[e, 0], t1, z[e, 1], t2, z[e, 2], lanes)


@kernel
def point_covariances(entries, start, stop, kept, row_start, column, inverse, width, out):
    """Covariances L^-T (I + sum Z_a^T (S^-1)_ab Z_b) L^-1 of points start..stop, for unit noise.

    `inverse` holds the blocks of S^-1 at the nonzero blocks of S, its lower triangle by rows. Fixed points get zeros.
    """
    for j in range(start, stop):
        first, last, f, m = entries.start[j], entries.start[j + 1], kept.factor[j], out[j]
        for a in range(3):
            for b in range(3):
                m[a, b] = 1.0 if a == b else 0.0
        for e in range(first, last):
            for other in range(first, last):
                a, b = entries.node[e], entries.node[other]
                low, high = row_start[max(a, b)], row_start[max(a, b) + 1]
                while high - low > 1:
                    middle = (low + high) // 2
                    if column[middle] <= min(a, b):
                        low = middle
                    else:
                        high = middle
                for p in range(width[a]):
                    for q in range(width[b]):
                        value = inverse[low, p, q] if a >= b else inverse[low, q, p]
                        for c in range(3):
                            for d in range(3):
                                m[c, d] += kept.z[e, c, p] * value * kept.z[other, d, q]
        # L^-1 = [[i0, 0, 0], [k10, i1, 0], [k20, k21, i2]]; m -> L^-T m L^-1
        k10, k21 = -f[2] * f[1] * f[0], -f[5] * f[4] * f[2]
        k20 = -f[5] * (f[3] * f[0] + f[4] * k10)
        for row in range(3):
            r0, r1, r2 = m[row, 0], m[row, 1], m[row, 2]
            m[row, 0] = r0 * f[0] + r1 * k10 + r2 * k20
            m[row, 1] = r1 * f[2] + r2 * k21
            m[row, 2] = r2 * f[5]
        for col in range(3):
            r0, r1, r2 = m[0, col], m[1, col], m[2, col]
            m[0, col] = f[0] * r0 + k10 * r1 + k20 * r2
            m[1, col] = f[2] * r1 + k21 * r2
            m[2, col] = f[5] * r2
