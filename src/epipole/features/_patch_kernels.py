"""Alignment of small patches to a fraction of a pixel, the look of each foretold by an affine warp."""

import math

import numpy as np

from epipole._jit import kernel

MOST_STEPS = 12
SETTLED_SQ = 0.01 * 0.01
"""Squared step, in pixels, at which a patch has settled."""


@kernel(fuse=True)
def _value_at(image, x, y):
    """Bilinear value of a picture of bytes; (x, y) is inside by a pixel."""
    column, row = int(x), int(y)
    a, b = x - column, y - row
    upper = (1.0 - a) * image[row, column] + a * image[row, column + 1]
    lower = (1.0 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    return (1.0 - b) * upper + b * lower


@kernel
def _warped_patch(image, x, y, warp, half, patch):
    """The patch as the other picture should show it; False where it leaves its own picture.

    patch[i, j] is the value at (x, y) + warp^-1 (j - half - 1, i - half - 1), with a border of one for gradients.
    """
    determinant = warp[0, 0] * warp[1, 1] - warp[0, 1] * warp[1, 0]
    if not abs(determinant) > 1e-3:
        return False
    a, b = warp[1, 1] / determinant, -warp[0, 1] / determinant
    c, d = -warp[1, 0] / determinant, warp[0, 0] / determinant
    reach = half + 1
    side = 2 * reach + 1
    far_x, far_y = (abs(a) + abs(b)) * reach, (abs(c) + abs(d)) * reach
    height, width = image.shape
    if not (x - far_x >= 0 and y - far_y >= 0 and x + far_x < width - 1 and y + far_y < height - 1):
        return False
    for i in range(side):
        for j in range(side):
            u, v = j - reach, i - reach
            patch[i, j] = _value_at(image, x + a * u + b * v, y + c * u + d * v)
    return True


@kernel(allocates=True)
def align_patches(image, other, pixels, warps, half, start, stop, found, score):
    """Place each patch of `image` in `other`; found holds guesses and becomes the places.

    Inverse compositional Gauss-Newton over the shift, a gain and an offset of brightness (Baker and Matthews, IJCV 2004;
    the warp of the template as Forster et al., SVO, ICRA 2014). score becomes the correlation of the patches, from -1 to
    1, and NaN where a patch left its picture or is flat.
    """
    side = 2 * half + 1
    patch = np.empty((side + 2, side + 2))
    gx, gy, seen = np.empty((side, side)), np.empty((side, side)), np.empty((side, side))
    height, width = other.shape
    count = float(side * side)
    for k in range(start, stop):
        score[k] = math.nan
        if not _warped_patch(image, pixels[k, 0], pixels[k, 1], warps[k], half, patch):
            continue
        mean, mean_x, mean_y = 0.0, 0.0, 0.0
        for i in range(side):
            for j in range(side):
                gx[i, j] = 0.5 * (patch[i + 1, j + 2] - patch[i + 1, j])
                gy[i, j] = 0.5 * (patch[i + 2, j + 1] - patch[i, j + 1])
                mean += patch[i + 1, j + 1]
                mean_x += gx[i, j]
                mean_y += gy[i, j]
        mean, mean_x, mean_y = mean / count, mean_x / count, mean_y / count
        xx, xy, yy, spread = 0.0, 0.0, 0.0, 0.0
        for i in range(side):
            for j in range(side):
                gx[i, j] -= mean_x
                gy[i, j] -= mean_y
                patch[i + 1, j + 1] -= mean
                xx += gx[i, j] * gx[i, j]
                xy += gx[i, j] * gy[i, j]
                yy += gy[i, j] * gy[i, j]
                spread += patch[i + 1, j + 1] * patch[i + 1, j + 1]
        determinant = xx * yy - xy * xy
        if not (determinant > 1e-6 * (xx + yy) * (xx + yy) and spread > count):
            continue
        x, y = found[k, 0], found[k, 1]
        for step in range(MOST_STEPS + 1):
            if not (x >= half and y >= half and x < width - half - 1 and y < height - half - 1):
                score[k] = math.nan
                break
            level, power, product = 0.0, 0.0, 0.0
            for i in range(side):
                for j in range(side):
                    seen[i, j] = _value_at(other, x + j - half, y + i - half)
                    level += seen[i, j]
            level /= count
            for i in range(side):
                for j in range(side):
                    value = seen[i, j] - level
                    power += value * value
                    product += value * patch[i + 1, j + 1]
            if not power > 0.1 * count:
                score[k] = math.nan
                break
            score[k] = product / math.sqrt(power * spread)
            if step == MOST_STEPS:
                break
            gain = math.sqrt(spread / power)
            bx, by = 0.0, 0.0
            for i in range(side):
                for j in range(side):
                    error = gain * (seen[i, j] - level) - patch[i + 1, j + 1]
                    bx += gx[i, j] * error
                    by += gy[i, j] * error
            dx, dy = (yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant
            size_sq = dx * dx + dy * dy
            if size_sq > 1.0:
                dx, dy = dx / math.sqrt(size_sq), dy / math.sqrt(size_sq)
            x, y = x - dx, y - dy
            if size_sq < SETTLED_SQ:
                break
        found[k, 0], found[k, 1] = x, y
