"""Rays through a grid of cells: entry, exit, and skipping of empty blocks."""

import math

import numpy as np

from epipole._jit import kernel

BLOCK = 8
"""Cells along the side of a block; empty blocks are skipped."""


@kernel(fuse=True)
def enter(occupied, origin, direction):
    """Ray parameters at which a ray enters and leaves the grid, in voxels; it misses the grid unless near < far."""
    near, far = np.float32(0.0), np.float32(1e30)
    for k in range(3):
        most = np.float32(occupied.shape[k]) - np.float32(1e-3)
        if abs(direction[k]) < np.float32(1e-9):
            if not np.float32(0.0) <= origin[k] <= most:
                return np.float32(1.0), np.float32(0.0)
            continue
        a, b = -origin[k] / direction[k], (most - origin[k]) / direction[k]
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return near, far


@kernel(fuse=True)
def past_block(origin, direction, ix, iy, iz, t):
    """Ray parameter at which a ray leaves its block."""
    leaves = np.float32(1e30)
    for k in range(3):
        cell = ix if k == 0 else (iy if k == 1 else iz)
        d = direction[k]
        if abs(d) < np.float32(1e-9):
            continue
        corner = cell // BLOCK * BLOCK
        edge = np.float32(corner + BLOCK) if d > np.float32(0.0) else np.float32(corner)
        leaves = min(leaves, (edge - origin[k]) / d)
    return max(leaves, t)


@kernel(fuse=True)
def ray_of_pixel(rays, view, column, row, low, size, origin, direction):
    """Origin and unit direction of a pixel's ray, in voxels."""
    x = (column - rays.intrinsics[view, 2]) / rays.intrinsics[view, 0]
    y = (row - rays.intrinsics[view, 3]) / rays.intrinsics[view, 1]
    length = math.sqrt(x * x + y * y + 1.0)
    r = rays.rotation[view]
    for k in range(3):
        direction[k] = (r[k] * x + r[3 + k] * y + r[6 + k]) / length
        origin[k] = (rays.center[view, k] - low[k]) / size
