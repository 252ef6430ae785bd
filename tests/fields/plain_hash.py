"""A neural field queried along rays as the equations stand: one sample after the other, in double precision."""

import numpy as np
from plain_rasterizer import basis

STEP, SHIFT, OVER = 0.5, -5.0, 1e-3


def features_of(tables, cells, position):
    """Trilinear features of all levels at a place in [0, 1]."""
    out, rows = [], tables.shape[1]
    for side, table in zip(cells.tolist(), tables):
        at = position * side
        cell = np.floor(at).astype(int)
        part, total = at - cell, np.zeros(4)
        for corner in np.ndindex(2, 2, 2):
            i, j, k = (cell + corner).tolist()
            if (side + 1) ** 3 > rows:
                row = (i ^ j * 2654435761 ^ k * 805459861) % rows
            else:
                row = (k * (side + 1) + j) * (side + 1) + i
            total += np.prod(np.where(corner, part, 1 - part)) * table[row]
        out.append(total)
    return np.concatenate(out)


def density_of(tables, cells, weights, position):
    """What the first two layers say: density before its exponential, and 15 features."""
    return np.maximum(features_of(tables, cells, position) @ weights[0], 0) @ weights[1]


def color_of(weights, said, direction):
    """What the other three layers say of a color seen in a direction."""
    value = np.concatenate([said, basis(direction[None], 16)[0]])
    for layer in weights[2:4]:
        value = np.maximum(value @ layer, 0)
    return 1 / (1 + np.exp(-value @ weights[4]))


def plain_ray(tables, weights, field, center, direction, first, background):
    """Color of a ray in the world, its distance times coverage in cells, and what it lets through."""
    room = field.room
    origin = (center - room.low) / room.size
    most = np.array(room.occupied.shape) - 1e-3
    with np.errstate(divide="ignore"):
        ends = np.stack([-origin / direction, (most - origin) / direction])
    near, far = max(0.0, ends.min(axis=0).max()), ends.max(axis=0).min()
    color, away, left = np.zeros(3), 0.0, 1.0
    t = near + first * STEP
    while t < far and left >= OVER:
        position = origin + t * direction
        if room.occupied[tuple(np.floor(position).astype(int))]:
            said = density_of(tables, field.cells, weights, position / max(room.occupied.shape))
            alpha = 1 - np.exp(-np.exp(said[0] + SHIFT) * STEP)
            color += left * alpha * color_of(weights, said, direction)
            away += left * alpha * t
            left *= 1 - alpha
        t += STEP
    return color + left * background, away, left
