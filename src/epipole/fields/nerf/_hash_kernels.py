"""Ray sampling, hash encoding and compositing (Mueller, Evans, Schied and Keller, Instant-NGP, 2022; Max 1995).

A sample in [0, 1]^3 has features from several levels. A level with s cells per side interpolates trilinearly between
the eight corners of the sample's cell, each a row of the level's table. If the table has a row for each corner, rows
are indexed directly; otherwise corner (i, j, k) has row (i xor 2654435761 j xor 805459861 k) mod rows, and the other
levels and the network resolve collisions.

With step length delta, sigma = exp(raw + SHIFT) and alpha = 1 - exp(-sigma delta), a ray's color is
    C = sum_i T_i alpha_i c_i + T_end background,  T_i = prod_{j<i} (1 - alpha_j);  with v_i = c_i . dL/dC
    dL/draw_i = sigma_i delta (T_{i+1} v_i - sum_{j>i} T_j alpha_j v_j - T_end background . dL/dC).
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.fields.nerf._march_kernels import BLOCK, enter, past_block, ray_of_pixel
from epipole.fields.splat._projection_kernels import harmonics

STEP = np.float32(0.5)
"""Distance between samples, in cells."""
SHIFT, LARGEST_RAW = np.float32(-5.0), np.float32(15.0)
"""Offset added to the network's density output, and upper limit of the sum."""
OVER = np.float32(1e-3)
"""Transmittance below which a ray is terminated."""
PRIMES = (np.uint32(2654435761), np.uint32(805459861))
BEFORE, ALPHA, THICKNESS = 0, 1, 2
"""Columns of `light`: transmittance before the sample, alpha, and sigma delta."""


@kernel
def sample_rays(rays, pixel_of, view_of, room, start, stop, most, at, positions, counts, basis, work):
    """Take the next samples, at most `most` per ray, of rays start..stop in occupied cells; returns their number.

    pixel_of (n,) are pixels in views view_of (n,). at (n,) is the ray parameter to continue from, in cells from the
    camera; a new ray has its first offset minus 1 (below 0), and a ray that has left the grid gets infinity. positions
    (capacity, 4) gets the samples in [0, 1]^3 and their distance in cells; counts (stop - start,) their number; basis
    (stop - start, 16) the harmonics of the directions. A ray that exceeds the capacity gets no samples.
    """
    origin, direction = work[0], work[1]
    side = np.float32(1.0) / np.float32(max(room.occupied.shape))
    found = 0
    for n in range(start, stop):
        view = view_of[n]
        width = rays.width[view]
        row, column = pixel_of[n] // width, pixel_of[n] % width
        ray_of_pixel(rays, view, column, row, room.low, room.size, origin, direction)
        harmonics(direction[0], direction[1], direction[2], 16, basis[n - start])
        near, far = enter(room.occupied, origin, direction)
        t = at[n]
        if t < np.float32(0.0):
            t = near + (t + np.float32(1.0)) * STEP
        count, is_full = 0, False
        while t < far and count < most:
            x, y, z = origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2]
            ix, iy, iz = int(x), int(y), int(z)
            if not room.blocks[ix // BLOCK, iy // BLOCK, iz // BLOCK]:
                ahead = past_block(origin, direction, ix, iy, iz, t) - t
                t += STEP * max(np.float32(1.0), np.float32(math.ceil(ahead / STEP)))
                continue
            t += STEP
            if not room.occupied[ix, iy, iz]:
                continue
            if found + count == len(positions):
                is_full = True
                break
            position = positions[found + count]
            position[0], position[1], position[2], position[3] = x * side, y * side, z * side, t - STEP
            count += 1
        at[n] = t if t < far else np.float32(np.inf)
        counts[n - start] = 0 if is_full else count
        found += counts[n - start]
    return found


@kernel(fuse=True)
def _row_of(i, j, k, cells, mask, is_hashed):
    if is_hashed:
        own = np.uint32(i) ^ np.uint32(np.uint32(j) * PRIMES[0]) ^ np.uint32(np.uint32(k) * PRIMES[1])
        return np.int64(own & mask)
    return (np.int64(k) * (cells + 1) + j) * (cells + 1) + i


@kernel(fuse=True)
def _cell_of(position, scale):
    """Cell of a position, and the fractional offset in it."""
    x, y, z = position[0] * scale, position[1] * scale, position[2] * scale
    ix, iy, iz = int(x), int(y), int(z)
    return ix, iy, iz, x - np.float32(ix), y - np.float32(iy), z - np.float32(iz)


@kernel(fuse=True)
def encode(positions, cells, tables, features):
    """Features (n, levels * 4) of positions (n, 4), level by level for the cache; tables (levels, 2^k rows, 4)."""
    levels, rows = tables.shape[0], tables.shape[1]
    mask, one = np.uint32(rows - 1), np.float32(1.0)
    for level in range(levels):
        side, table = cells[level], tables[level]
        scale, is_hashed = np.float32(side), (side + 1) ** 3 > rows
        for n in range(len(positions)):
            ix, iy, iz, fx, fy, fz = _cell_of(positions[n], scale)
            a = b = c = d = np.float32(0.0)
            for k in range(2):
                wz = fz if k else one - fz
                for j in range(2):
                    wyz = wz * (fy if j else one - fy)
                    for i in range(2):
                        row = _row_of(ix + i, iy + j, iz + k, side, mask, is_hashed)
                        weight = wyz * (fx if i else one - fx)
                        a += weight * table[row, 0]
                        b += weight * table[row, 1]
                        c += weight * table[row, 2]
                        d += weight * table[row, 3]
            out = features[n]
            out[4 * level], out[4 * level + 1], out[4 * level + 2], out[4 * level + 3] = a, b, c, d


@kernel(fuse=True)
def spread(positions, cells, level, by_features, gradient):
    """Add the gradient of a level's table (rows, 4), given by_features (n, levels * 4)."""
    rows, side = len(gradient), cells[level]
    mask, one = np.uint32(rows - 1), np.float32(1.0)
    scale, is_hashed = np.float32(side), (side + 1) ** 3 > rows
    for n in range(len(positions)):
        ix, iy, iz, fx, fy, fz = _cell_of(positions[n], scale)
        by = by_features[n]
        a, b, c, d = by[4 * level], by[4 * level + 1], by[4 * level + 2], by[4 * level + 3]
        for k in range(2):
            wz = fz if k else one - fz
            for j in range(2):
                wyz = wz * (fy if j else one - fy)
                for i in range(2):
                    row = _row_of(ix + i, iy + j, iz + k, side, mask, is_hashed)
                    weight = wyz * (fx if i else one - fx)
                    gradient[row, 0] += weight * a
                    gradient[row, 1] += weight * b
                    gradient[row, 2] += weight * c
                    gradient[row, 3] += weight * d


@kernel
def weigh(said, counts, delta, left, light, kept, kept_counts):
    """Transmittance, alpha and optical thickness along rays, until they are opaque; returns the number of samples kept.

    said (n, 16) are the first network's outputs, density first; counts (rays,) samples per ray; left (rays,) the
    transmittance before them, which is updated. light (n, 3) gets BEFORE, ALPHA, THICKNESS; kept the indices of the
    visible samples; kept_counts (rays,) their number.
    """
    at, found = 0, 0
    for n in range(len(counts)):
        through = left[n]
        start = found
        for i in range(at, at + counts[n]):
            if through < OVER:
                break
            thickness = np.float32(math.exp(min(said[i, 0] + SHIFT, LARGEST_RAW))) * delta
            alpha = np.float32(1.0) - np.float32(math.exp(-thickness))
            light[found, BEFORE], light[found, ALPHA], light[found, THICKNESS] = through, alpha, thickness
            kept[found] = i
            found += 1
            through *= np.float32(1.0) - alpha
        at += counts[n]
        left[n] = through
        kept_counts[n] = found - start
    return found


@kernel
def join(said, kept, kept_counts, basis, out):
    """Color network input out (m, 32): the first network's outputs of kept samples, and harmonics (rays, 16)."""
    at = 0
    for n in range(len(kept_counts)):
        for i in range(at, at + kept_counts[n]):
            for k in range(16):
                out[i, k] = said[kept[i], k]
                out[i, 16 + k] = basis[n, k]
        at += kept_counts[n]


@kernel
def compose(colors, light, positions, kept, kept_counts, image):
    """Apply the logistic function to colors (m, 3) in place; add colors and distances to image (rays, 4)."""
    at, one = 0, np.float32(1.0)
    for n in range(len(kept_counts)):
        for i in range(at, at + kept_counts[n]):
            weight = light[i, BEFORE] * light[i, ALPHA]
            for k in range(3):
                colors[i, k] = one / (one + np.float32(math.exp(-colors[i, k])))
                image[n, k] += weight * colors[i, k]
            image[n, 3] += weight * positions[kept[i], 3]
        at += kept_counts[n]


@kernel
def compose_back(colors, light, kept_counts, behind, by_image, by_colors, by_raw):
    """Derivatives w.r.t. the outputs for color (m, 3) and density (m,), given those w.r.t. the image (rays, 3).

    colors (m, 3) are after the logistic function; behind (rays,) is dL/dC . background times the final transmittance.
    """
    at, one = 0, np.float32(1.0)
    for n in range(len(kept_counts)):
        rest = behind[n]
        for i in range(at + kept_counts[n] - 1, at - 1, -1):
            before, alpha = light[i, BEFORE], light[i, ALPHA]
            value = np.float32(0.0)
            for k in range(3):
                value += by_image[n, k] * colors[i, k]
                slope = colors[i, k] * (one - colors[i, k])
                by_colors[i, k] = before * alpha * by_image[n, k] * slope
            by_raw[i] = light[i, THICKNESS] * (before * (one - alpha) * value - rest)
            rest += before * alpha * value
        at += kept_counts[n]


@kernel
def limit_change(by, value):
    """Backward pass of a ReLU: clear derivatives (n, k) where its output is 0."""
    one, other = by.reshape(-1), value.reshape(-1)
    for i in range(len(one)):
        if not other[i] > np.float32(0.0):
            one[i] = np.float32(0.0)
