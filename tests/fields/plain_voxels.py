"""Marching through a grid as the equations stand: one sample after the other, in double precision."""

import numpy as np
from plain_rasterizer import basis

STEP, SHIFT = 0.7, -4.6


def between(values, index, position):
    """The row at a place, linearly between the eight corners of its cell."""
    cell = np.floor(position).astype(int)
    part = position - cell
    out = np.zeros(values.shape[1])
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, part, 1 - part))
        out += weight * values[index[tuple(cell + corner)]]
    return out


def plain_ray(values, voxels, center, direction, first, background):
    """Color of a ray in the world, its distance times coverage, and what it lets through."""
    origin = (center - voxels.low) / voxels.size
    most = np.array(voxels.row_of.shape) - 1 - 1e-3
    with np.errstate(divide="ignore"):
        ends = np.stack([-origin / direction, (most - origin) / direction])
    near, far = max(0.0, ends.min(axis=0).max()), ends.max(axis=0).min()
    color, away, left = np.zeros(3), 0.0, 1.0
    harmonics = basis(direction[None], 4)[0]
    t = near + first * STEP
    while t < far:
        position = origin + t * direction
        if voxels.occupied[tuple(np.floor(position).astype(int))]:
            row = between(values, voxels.row_of, position)
            alpha = 1 - np.exp(-np.logaddexp(0, row[0] + SHIFT) * float(voxels.delta))
            seen = np.maximum(0.5 + harmonics @ row[1:13].reshape(4, 3), 0)
            color += left * alpha * seen
            away += left * alpha * t
            left *= 1 - alpha
        t += STEP
    return color + left * background, away, left
