"""Sparse volume of signed distances: blocks along surfaces, integration of depth, and surface nets."""

import numpy as np

from epipole._jit import kernel

SIDE = 8
"""Voxels along each side of a block."""
OFFSET = 1 << 20
"""Added to block coordinates, so that they are positive in a key of three times 21 bits."""


@kernel
def touched_blocks(depth, view, size, band, stride, start, stop, keys):
    """Keys of the blocks within the band of each stride-th pixel's depth, of rows start..stop; returns their number.

    view = (world_from_cam rotation (9), center (3), K (fx, fy, cx, cy)). size: side of a block. Consecutive equal keys are written once.
    """
    r, c, k = view
    number, last = 0, -1
    for v in range(start, stop, stride):
        for u in range(0, depth.shape[1], stride):
            z = depth[v, u]
            if not 0.0 < z < np.inf:
                continue
            x, y = (u - k[2]) / k[0], (v - k[3]) / k[1]
            dx = r[0] * x + r[1] * y + r[2]
            dy = r[3] * x + r[4] * y + r[5]
            dz = r[6] * x + r[7] * y + r[8]
            for step in range(-2, 3):
                s = z + 0.5 * step * band
                bx = int(np.floor((c[0] + s * dx) / size)) + OFFSET
                by = int(np.floor((c[1] + s * dy) / size)) + OFFSET
                bz = int(np.floor((c[2] + s * dz) / size)) + OFFSET
                key = (bx << 42) | (by << 21) | bz
                if key != last:
                    keys[number] = key
                    number += 1
                    last = key
    return number


@kernel
def integrate(depth, sigma, view, blocks, voxel, band, start, stop, distance, weight):
    """Integrate a depth image into blocks start..stop (Curless and Levoy, SIGGRAPH 1996), weighted by the inverse variance.

    view = (cam_from_world rotation (9), translation (3), K (fx, fy, cx, cy)). blocks (b, 3): coordinates. distance (b, 8, 8, 8) is a mean in
    units of the band, at most 1; voxels more than a band behind the surface are not changed. An infinite depth is free space. A weight of one
    is a depth without error.
    """
    r, t, k = view
    height, width = depth.shape
    reach = 0.5 * np.sqrt(3.0) * SIDE * voxel
    for b in range(start, stop):
        ox, oy, oz = blocks[b, 0] * SIDE * voxel, blocks[b, 1] * SIDE * voxel, blocks[b, 2] * SIDE * voxel
        half = 0.5 * SIDE * voxel
        mx, my, mz = ox + half, oy + half, oz + half
        cz = r[6] * mx + r[7] * my + r[8] * mz + t[2]
        if cz <= reach:
            continue
        cu = k[0] * (r[0] * mx + r[1] * my + r[2] * mz + t[0]) / cz + k[2]
        cv = k[1] * (r[3] * mx + r[4] * my + r[5] * mz + t[1]) / cz + k[3]
        radius = max(k[0], k[1]) * reach / (cz - reach) * 1.5
        if cu < -radius or cv < -radius or cu > width + radius or cv > height + radius:
            continue
        for i in range(SIDE):
            px = ox + voxel * (i + 0.5)
            for j in range(SIDE):
                py = oy + voxel * (j + 0.5)
                for n in range(SIDE):
                    pz = oz + voxel * (n + 0.5)
                    z = r[6] * px + r[7] * py + r[8] * pz + t[2]
                    u = k[0] * (r[0] * px + r[1] * py + r[2] * pz + t[0]) / z + k[2] + 0.5
                    v = k[1] * (r[3] * px + r[4] * py + r[5] * pz + t[1]) / z + k[3] + 0.5
                    if not (u >= 0.0 and v >= 0.0 and u < width and v < height):
                        continue
                    row, column = int(v), int(u)
                    seen = depth[row, column]
                    if not seen > 0.0:
                        continue
                    ahead = (seen - z) / band
                    if ahead < -1.0:
                        continue
                    relative = sigma[row, column] / voxel
                    add = np.float32(1.0 / (1.0 + relative * relative))
                    total = weight[b, i, j, n] + add
                    distance[b, i, j, n] += add / total * (np.float32(min(ahead, 1.0)) - distance[b, i, j, n])
                    weight[b, i, j, n] = total


@kernel
def net_vertices(blocks, neighbors, distance, weight, least, corner, start, stop, vertices, index):
    """Surface-net vertices of cells of blocks start..stop (Gibson, MICCAI 1998); returns their number.

    A cell has the voxel (i, j, k) and the next ones as corners. If all were seen (weight >= least) and signs differ, its vertex is the mean of the
    zero crossings along its twelve edges. neighbors (b, 8): the blocks at offsets (dx, dy, dz) in {0, 1}, 4 dx + 2 dy + dz, -1 where missing.
    corner (8): memory. vertices (n, 3) receives positions in voxels; index (b, 8, 8, 8) the number of the vertex within start..stop, or -1.
    """
    number = 0
    for b in range(start, stop):
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    index[b, i, j, k] = -1
                    negative, complete = 0, True
                    for c in range(8):
                        ii, jj, kk = i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)
                        at = neighbors[b, 4 * (ii // SIDE) + 2 * (jj // SIDE) + kk // SIDE]
                        if at < 0 or weight[at, ii % SIDE, jj % SIDE, kk % SIDE] < least:
                            complete = False
                            break
                        corner[c] = distance[at, ii % SIDE, jj % SIDE, kk % SIDE]
                        negative += corner[c] < 0.0
                    if not complete or negative == 0 or negative == 8:
                        continue
                    x = y = z = 0.0
                    crossings = 0
                    for c in range(8):
                        for axis in range(3):
                            bit = 4 >> axis
                            if c & bit:
                                continue
                            one, two = corner[c], corner[c | bit]
                            if (one < 0.0) == (two < 0.0):
                                continue
                            fraction = one / (one - two)
                            x += (c >> 2) + (fraction if axis == 0 else 0.0)
                            y += ((c >> 1) & 1) + (fraction if axis == 1 else 0.0)
                            z += (c & 1) + (fraction if axis == 2 else 0.0)
                            crossings += 1
                    vertices[number, 0] = blocks[b, 0] * SIDE + i + 0.5 + x / crossings
                    vertices[number, 1] = blocks[b, 1] * SIDE + j + 0.5 + y / crossings
                    vertices[number, 2] = blocks[b, 2] * SIDE + k + 0.5 + z / crossings
                    index[b, i, j, k] = number
                    number += 1
    return number


@kernel
def net_faces(ahead, behind, distance, index, quad, start, stop, faces):
    """Two triangles for each edge between voxels of different sign, of blocks start..stop; returns their number.

    The edge from a voxel along an axis is shared by four cells; all must have a vertex. ahead, behind (b, 8): blocks at offsets 0, 1 and 0, -1, as
    in `net_vertices`. Corners are counterclockwise seen from the positive side, in front of the surface.
    """
    number = 0
    for b in range(start, stop):
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    here = distance[b, i, j, k]
                    for axis in range(3):
                        ii, jj, kk = i + (axis == 0), j + (axis == 1), k + (axis == 2)
                        at = ahead[b, 4 * (ii // SIDE) + 2 * (jj // SIDE) + kk // SIDE]
                        if at < 0:
                            continue
                        there = distance[at, ii % SIDE, jj % SIDE, kk % SIDE]
                        if (here < 0.0) == (there < 0.0):
                            continue
                        complete = True
                        for c in range(4):
                            back, side = c >> 1, (c & 1) ^ (c >> 1)  # around the edge: 00, 01, 11, 10
                            bi, bj, bk = i, j, k
                            if axis == 0:
                                bj, bk = j - back, k - side
                            elif axis == 1:
                                bk, bi = k - back, i - side
                            else:
                                bi, bj = i - back, j - side
                            cell = behind[b, 4 * (bi < 0) + 2 * (bj < 0) + (bk < 0)]
                            quad[c] = index[cell, bi % SIDE, bj % SIDE, bk % SIDE] if cell >= 0 else -1
                            complete = complete and quad[c] >= 0
                        if not complete:
                            continue
                        first, third = (3, 1) if here < 0.0 else (1, 3)
                        faces[number, 0], faces[number, 1], faces[number, 2] = quad[0], quad[first], quad[2]
                        faces[number + 1, 0], faces[number + 1, 1], faces[number + 1, 2] = (
                            quad[0],
                            quad[2],
                            quad[third],
                        )
                        number += 2
    return number
