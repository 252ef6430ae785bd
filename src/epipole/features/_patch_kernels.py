"""Subpixel alignment of small patches, each predicted by a warp of first or second order."""

import math

import numpy as np

from epipole._jit import kernel

REASSOC = frozenset({"reassoc"})
"""Allow reassociation of sums over a patch, so that they vectorize; only in loops that write nothing."""
MOST_STEPS = 12
CONVERGED_SQ = 0.01 * 0.01
"""Squared step, in pixels, at which a patch has converged."""


@kernel(fuse=True)
def _value_at(image, x, y):
    """Bilinear value of a byte image; (x, y) must be at least one pixel inside."""
    column, row = int(x), int(y)
    a, b = x - column, y - row
    upper = (1.0 - a) * image[row, column] + a * image[row, column + 1]
    lower = (1.0 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    return (1.0 - b) * upper + b * lower


@kernel
def _warped_patch(image, x, y, warp, half, patch):
    """The patch as predicted for the other image; False if it leaves its own image.

    patch[i, j] is the value at (x, y) + p, with a border of one for gradients. For w = (j - half - 1, i - half - 1), p is A^-1 w less
    the second order A^-1 H[p, p] / 2; warp has the columns A, then H_uu, H_uv, H_vv.
    """
    determinant = warp[0, 0] * warp[1, 1] - warp[0, 1] * warp[1, 0]
    if not abs(determinant) > 1e-3:
        return False
    a, b = warp[1, 1] / determinant, -warp[0, 1] / determinant
    c, d = -warp[1, 0] / determinant, warp[0, 0] / determinant
    reach = half + 1
    side = 2 * reach + 1
    far_x, far_y = (abs(a) + abs(b)) * reach, (abs(c) + abs(d)) * reach
    far_u, far_v = 0.0, 0.0
    for term, size in enumerate((0.5 * far_x * far_x, far_x * far_y, 0.5 * far_y * far_y)):
        far_u, far_v = far_u + abs(warp[0, 2 + term]) * size, far_v + abs(warp[1, 2 + term]) * size
    far_x, far_y = far_x + abs(a) * far_u + abs(b) * far_v, far_y + abs(c) * far_u + abs(d) * far_v
    height, width = image.shape
    if not (x - far_x >= 0 and y - far_y >= 0 and x + far_x < width - 1 and y + far_y < height - 1):
        return False
    for i in range(side):
        for j in range(side):
            u, v = j - reach, i - reach
            p, q = a * u + b * v, c * u + d * v
            e = 0.5 * warp[0, 2] * p * p + warp[0, 3] * p * q + 0.5 * warp[0, 4] * q * q
            f = 0.5 * warp[1, 2] * p * p + warp[1, 3] * p * q + 0.5 * warp[1, 4] * q * q
            patch[i, j] = _value_at(image, x + (p - (a * e + b * f)), y + (q - (c * e + d * f)))
    return True


@kernel(fuse=True, extra_fastmath=REASSOC)
def _compare(other, x, y, half, patch, gx, gy, sums):
    """Sums over the patch at (x, y): of values s, s^2, s patch, s gx, s gy."""
    side = 2 * half + 1
    left, top = x - half, y - half
    column, row = int(left), int(top)
    a, b = left - column, top - row
    w00, w01, w10, w11 = (1.0 - b) * (1.0 - a), (1.0 - b) * a, b * (1.0 - a), b * a
    total, squares, product, along_x, along_y = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(side):
        upper, lower = other[row + i, column:], other[row + i + 1, column:]
        p, dx, dy = patch[i], gx[i], gy[i]
        for j in range(side):
            value = w00 * upper[j] + w01 * upper[j + 1] + w10 * lower[j] + w11 * lower[j + 1]
            total += value
            squares += value * value
            product += value * p[j]
            along_x += value * dx[j]
            along_y += value * dy[j]
    sums[0], sums[1], sums[2], sums[3], sums[4] = total, squares, product, along_x, along_y


@kernel(fuse=True)
def _template(bordered, side, patch, gx, gy):
    """A patch without its border, and its gradients, both with zero mean."""
    mean, mean_x, mean_y = 0.0, 0.0, 0.0
    for i in range(side):
        for j in range(side):
            patch[i, j] = bordered[i + 1, j + 1]
            gx[i, j] = 0.5 * (bordered[i + 1, j + 2] - bordered[i + 1, j])
            gy[i, j] = 0.5 * (bordered[i + 2, j + 1] - bordered[i, j + 1])
            mean += patch[i, j]
            mean_x += gx[i, j]
            mean_y += gy[i, j]
    count = side * side
    for i in range(side):
        for j in range(side):
            patch[i, j] -= mean / count
            gx[i, j] -= mean_x / count
            gy[i, j] -= mean_y / count


@kernel(fuse=True, extra_fastmath=REASSOC)
def _sums_of_template(patch, gx, gy):
    """Sums of gx^2, gx gy, gy^2, patch^2, gx patch, gy patch."""
    xx, xy, yy, spread, own_x, own_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(patch)):
        p, dx, dy = patch[i], gx[i], gy[i]
        for j in range(len(p)):
            xx += dx[j] * dx[j]
            xy += dx[j] * dy[j]
            yy += dy[j] * dy[j]
            spread += p[j] * p[j]
            own_x += dx[j] * p[j]
            own_y += dy[j] * p[j]
    return xx, xy, yy, spread, own_x, own_y


@kernel(allocates=True)
def align_patches(image, other, pixels, warps, half, start, stop, found, score):
    """Locate each patch of `image` in `other`; `found` holds guesses and receives the positions.

    Inverse compositional Gauss-Newton over a shift, a gain and a brightness offset (Baker and Matthews, IJCV 2004; warped
    template as in Forster et al., SVO, ICRA 2014). Patch and gradients have zero mean, so the offset drops out of every
    sum. score receives the correlation of the patches, from -1 to 1, or NaN if a patch left its image or is flat.
    """
    side = 2 * half + 1
    bordered, patch = np.empty((side + 2, side + 2)), np.empty((side, side))
    gx, gy, sums = np.empty((side, side)), np.empty((side, side)), np.empty(5)
    height, width = other.shape
    count = float(side * side)
    for k in range(start, stop):
        score[k] = math.nan
        if not _warped_patch(image, pixels[k, 0], pixels[k, 1], warps[k], half, bordered):
            continue
        _template(bordered, side, patch, gx, gy)
        xx, xy, yy, spread, own_x, own_y = _sums_of_template(patch, gx, gy)
        determinant = xx * yy - xy * xy
        if not (determinant > 1e-6 * (xx + yy) * (xx + yy) and spread > count):
            continue
        x, y = found[k, 0], found[k, 1]
        for step in range(MOST_STEPS + 1):
            if not (x >= half and y >= half and x < width - half - 1 and y < height - half - 1):
                score[k] = math.nan
                break
            _compare(other, x, y, half, patch, gx, gy, sums)
            power = sums[1] - sums[0] * sums[0] / count
            if not power > 0.1 * count:
                score[k] = math.nan
                break
            score[k] = sums[2] / math.sqrt(power * spread)
            if step == MOST_STEPS:
                break
            gain = math.sqrt(spread / power)
            bx, by = gain * sums[3] - own_x, gain * sums[4] - own_y
            dx, dy = (yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant
            size_sq = dx * dx + dy * dy
            if size_sq > 1.0:
                dx, dy = dx / math.sqrt(size_sq), dy / math.sqrt(size_sq)
            x, y = x - dx, y - dy
            if size_sq < CONVERGED_SQ:
                break
        found[k, 0], found[k, 1] = x, y


@kernel(allocates=True)
def find_along_rows(image, other, pixels, max_shift, half, start, stop, out):
    """Best integer shift to the left for each patch, its correlation, and the best one two or more pixels away."""
    height, width = image.shape
    count = (2 * half + 1) * (2 * half + 1)
    scores = np.empty(max_shift + 1)
    for k in range(start, stop):
        x, y = round(pixels[k, 0]), round(pixels[k, 1])
        if not (x >= half and y >= half and x < width - half and y < height - half):
            continue
        total, squares = 0, 0
        for i in range(y - half, y + half + 1):
            for j in range(x - half, x + half + 1):
                value = int(image[i, j])
                total += value
                squares += value * value
        spread = count * squares - total * total
        if spread < count * count:  # a standard deviation of one gray level
            continue
        last = min(max_shift, x - half)
        best = 0
        for shift in range(last + 1):
            there, power, product = 0, 0, 0
            for i in range(y - half, y + half + 1):
                for j in range(x - half, x + half + 1):
                    value = int(other[i, j - shift])
                    there += value
                    power += value * value
                    product += value * int(image[i, j])
            across = count * power - there * there
            scores[shift] = -1.0
            if across > 0:
                scores[shift] = (count * product - there * total) / math.sqrt(float(across) * float(spread))
            if scores[shift] > scores[best]:
                best = shift
        rival = -1.0
        for shift in range(last + 1):
            if abs(shift - best) >= 2:
                rival = max(rival, scores[shift])
        out[k, 0], out[k, 1], out[k, 2] = best, scores[best], rival
