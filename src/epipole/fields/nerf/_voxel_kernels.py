"""Ray sampling, compositing and derivatives for a grid of densities and colors (Max 1995; Sun et al., DVGO, 2022).

With step length delta a ray's color is C = sum_i T_i alpha_i c_i + T_end background, alpha_i = 1 - exp(-sigma_i delta),
T_i = prod_{j<i} (1 - alpha_j); the weights and T_end sum to one. With v_i = c_i . dL/dC,
    dL/dsigma_i = delta (T_{i+1} v_i - sum_{j>i} T_j alpha_j v_j - T_end background . dL/dC).
Each corner has a row with the density before its softplus and harmonics up to degree 1 of red, green and blue; a sample
interpolates eight corners.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.fields.nerf._march_kernels import BLOCK, enter, past_block, ray_of_pixel
from epipole.fields.splat._projection_kernels import SH0, SH1
from epipole.fields.splat._simd_kernels import ROW, adam_row, add_row

STEP = np.float32(0.7)
"""Distance between samples, in voxels."""
MOST_SAMPLES = 512
OVER = np.float32(1e-3)
"""Transmittance below which a ray is terminated."""
SHIFT = np.float32(-4.6)
"""Offset of a density before its softplus, so that an untrained voxel transmits 99 %."""
LEAST_WEIGHT = np.float32(0.03)
"""Smallest weight of a sample that marks its cell as seen."""
LEAST_GRADIENT = np.float32(1e-12)
RECORD = 10
"""Floats of a record: fraction in its cell (3), dL/d raw density, dL/dcolor (3), direction (3)."""
FX, FY, FZ, BY_RAW, BY_RED, DX, DY, DZ = 0, 1, 2, 3, 4, 7, 8, 9


@kernel(fuse=True)
def _gather(voxels, flat, ix, iy, iz, fx, fy, fz, acc):
    """Interpolate the rows of eight corners into acc (16,)."""
    one = np.float32(1.0)
    for k in range(ROW):
        acc[k] = np.float32(0.0)
    for i in range(2):
        wx = fx if i else one - fx
        for j in range(2):
            wxy = wx * (fy if j else one - fy)
            for k in range(2):
                row = np.int64(voxels.row_of[ix + i, iy + j, iz + k])
                add_row(acc, 0, flat, row * ROW, wxy * (fz if k else one - fz))


@kernel(fuse=True)
def _softplus(x):
    """log(1 + e^x), and its derivative."""
    if x > np.float32(15.0):
        return x, np.float32(1.0)
    e = np.float32(math.exp(x))
    return np.float32(math.log1p(e)), e / (np.float32(1.0) + e)


@kernel(fuse=True)
def _march(voxels, flat, origin, direction, first, work):
    """Sample a ray from the camera on; returns the number of samples and the final transmittance.

    work.position (samples, 6) gets the cell and the fraction in it; work.light (samples, 6) transmittance, alpha,
    softplus' and color.
    """
    near, far = enter(voxels.occupied, origin, direction)
    one, half, zero = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    c0, c1 = np.float32(SH0), np.float32(SH1)
    b1, b2, b3 = -c1 * direction[1], c1 * direction[2], -c1 * direction[0]
    acc, light, position = work.acc, work.light, work.position
    left, count = one, 0
    t = near + first * STEP
    while t < far and count < MOST_SAMPLES:
        x, y, z = origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2]
        ix, iy, iz = int(x), int(y), int(z)
        if not voxels.blocks[ix // BLOCK, iy // BLOCK, iz // BLOCK]:
            ahead = past_block(origin, direction, ix, iy, iz, t) - t
            t += STEP * max(one, np.float32(math.ceil(ahead / STEP)))
            continue
        t += STEP
        if not voxels.occupied[ix, iy, iz]:
            continue
        fx, fy, fz = x - np.float32(ix), y - np.float32(iy), z - np.float32(iz)
        _gather(voxels, flat, ix, iy, iz, fx, fy, fz, acc)
        sigma, slope = _softplus(acc[0] + SHIFT)
        alpha = one - np.float32(math.exp(-sigma * voxels.delta))
        light[count, 0], light[count, 1], light[count, 2] = left, alpha, slope
        for k in range(3):
            color = half + c0 * acc[1 + k] + b1 * acc[4 + k] + b2 * acc[7 + k] + b3 * acc[10 + k]
            light[count, 3 + k] = max(color, zero)
        position[count, 0], position[count, 1], position[count, 2] = (
            np.float32(ix),
            np.float32(iy),
            np.float32(iz),
        )
        position[count, 3], position[count, 4], position[count, 5] = fx, fy, fz
        count += 1
        left *= one - alpha
        if left < OVER:
            break
    return count, left


@kernel
def render_pixels(rays, view, width, voxels, background, start, stop, image, depth, work):
    """Render pixels start..stop into flat image (h w, 3) and depth (h w,), along the ray in voxels, times coverage."""
    flat = voxels.values.reshape(-1)
    samples = 0
    for at in range(start, stop):
        ray_of_pixel(
            rays, view, at % width, at // width, voxels.low, voxels.size, work.origin, work.direction
        )
        count, left = _march(voxels, flat, work.origin, work.direction, np.float32(0.5), work)
        samples += count
        total = np.float32(0.0)
        for k in range(3):
            image[at, k] = left * background[k]
        for i in range(count):
            weight = work.light[i, 0] * work.light[i, 1]
            away = np.float32(0.0)
            for k in range(3):
                image[at, k] += weight * work.light[i, 3 + k]
                off = work.position[i, k] + work.position[i, 3 + k] - work.origin[k]
                away += off * off
            total += weight * np.float32(math.sqrt(away))
        depth[at] = total
    return samples


@kernel
def learn_rays(rays, chosen, first, voxels, background, scale, start, stop, records, cells, work):
    """Write samples of rays start..stop and their derivatives to records (capacity, RECORD) and cells (capacity,).

    chosen (n,) are pixels of all images, first (n,) the offset of the first sample in steps; the loss is scale times
    the squared error. Returns the number of records, the sum of squared errors, and the number of samples.
    """
    flat = voxels.values.reshape(-1)
    ny, nz = voxels.row_of.shape[1], voxels.row_of.shape[2]
    found, error, samples = 0, 0.0, 0
    by, wanted = work.by, work.wanted
    for n in range(start, stop):
        pixel = chosen[n]
        view = np.searchsorted(rays.offset, pixel, side="right") - 1
        at = pixel - rays.offset[view]
        width = rays.width[view]
        ray_of_pixel(
            rays, view, at % width, at // width, voxels.low, voxels.size, work.origin, work.direction
        )
        count, left = _march(voxels, flat, work.origin, work.direction, first[n], work)
        samples += count
        opaque = np.float32(rays.pixels[pixel, 3]) / np.float32(255.0)
        rest = np.float32(0.0)
        for k in range(3):
            seen = left * background[k]
            for i in range(count):
                seen += work.light[i, 0] * work.light[i, 1] * work.light[i, 3 + k]
            wanted[k] = np.float32(rays.pixels[pixel, k]) / np.float32(255.0) * opaque
            wanted[k] += (np.float32(1.0) - opaque) * background[k]
            off = seen - wanted[k]
            error += float(off) * float(off)
            by[k] = np.float32(2.0) * scale * off
            rest += by[k] * (seen - left * background[k])
        behind = left * (by[0] * background[0] + by[1] * background[1] + by[2] * background[2])
        if found + count > len(records):
            continue
        for i in range(count):
            before, alpha, slope = work.light[i, 0], work.light[i, 1], work.light[i, 2]
            weight = before * alpha
            ix, iy, iz = int(work.position[i, 0]), int(work.position[i, 1]), int(work.position[i, 2])
            if weight > LEAST_WEIGHT:
                voxels.seen[ix, iy, iz] = 1
            value = np.float32(0.0)
            for k in range(3):
                value += by[k] * work.light[i, 3 + k]
            rest -= weight * value
            after = before * (np.float32(1.0) - alpha)
            by_raw = voxels.delta * slope * (after * value - rest - behind)
            record = records[found]
            for k in range(3):
                record[FX + k] = work.position[i, 3 + k]
                record[BY_RED + k] = (
                    weight * by[k] if work.light[i, 3 + k] > np.float32(0.0) else np.float32(0.0)
                )
                record[DX + k] = work.direction[k]
            record[BY_RAW] = by_raw
            size = abs(by_raw) + abs(record[BY_RED]) + abs(record[BY_RED + 1]) + abs(record[BY_RED + 2])
            if size < LEAST_GRADIENT:
                continue
            cells[found] = (ix * ny + iy) * nz + iz
            found += 1
    return found, error, samples


@kernel
def move_planes(voxels, records, cells, order, plane_start, row_start, first, last, adam, one):
    """Add derivatives in planes first..last of constant x to their rows, with an Adam step of each row that got any.

    A record touches the planes on both sides of its cell. `order` sorts the records by cell, `plane_start` is the first
    one of each plane; one (16,) is scratch.
    """
    flat, gradient = voxels.values.reshape(-1), adam.gradient.reshape(-1)
    for plane in range(first, last):
        for at in range(plane_start[max(plane - 1, 0)], plane_start[plane]):
            _add_record(
                voxels, records[order[at]], cells[order[at]], plane, True, gradient, adam.touched, one
            )
        for at in range(plane_start[plane], plane_start[plane + 1]):
            _add_record(
                voxels, records[order[at]], cells[order[at]], plane, False, gradient, adam.touched, one
            )
        for row in range(row_start[plane], row_start[plane + 1]):
            if not adam.touched[row]:
                continue
            adam.touched[row] = 0
            adam_row(flat, gradient, adam.mean, adam.square, row * ROW, adam.rates)


@kernel(fuse=True)
def _add_record(voxels, record, cell, plane, is_behind, gradient, touched, one):
    """Add a sample's derivatives to the four corners of its cell that lie in a plane."""
    c0, c1, unit = np.float32(SH0), np.float32(SH1), np.float32(1.0)
    ny, nz = voxels.row_of.shape[1], voxels.row_of.shape[2]
    y, z = cell // nz % ny, cell % nz
    one[0] = record[BY_RAW]
    b1, b2, b3 = -c1 * record[DY], c1 * record[DZ], -c1 * record[DX]
    for k in range(3):
        g = record[BY_RED + k]
        one[1 + k], one[4 + k], one[7 + k], one[10 + k] = c0 * g, b1 * g, b2 * g, b3 * g
    wx = record[FX] if is_behind else unit - record[FX]
    for j in range(2):
        wxy = wx * (record[FY] if j else unit - record[FY])
        for k in range(2):
            row = np.int64(voxels.row_of[plane, y + j, z + k])
            add_row(gradient, row * ROW, one, 0, wxy * (record[FZ] if k else unit - record[FZ]))
            touched[row] = 1
