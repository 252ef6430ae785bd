"""SSIM and L1 of two images and their derivatives, element by element, between the blurs of SSIM."""

import numpy as np

from epipole._jit import kernel

C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
"""SSIM constants for values from 0 to 1 (Wang, Bovik, Sheikh and Simoncelli, IEEE TIP 2004)."""
BLOCK = 4096
"""Elements summed in single precision before they are added to a double."""


@kernel(fuse=True)
def ssim_terms(mean_x, mean_y, xx, yy, xy, start, stop, scale):
    """SSIM of elements start..stop of the flat blurred images x, y, x x, y y and x y.

    Overwrites mean_x, xx and xy with `scale` times d SSIM / d(blurred x, x x, x y). Returns the sum of SSIM.
    """
    one, two = np.float32(1.0), np.float32(2.0)
    total = 0.0
    for first_item in range(start, stop, BLOCK):
        part = np.float32(0.0)
        for k in range(first_item, min(first_item + BLOCK, stop)):
            mx, my = mean_x[k], mean_y[k]
            a1, b1 = two * mx * my + C1, mx * mx + my * my + C1
            a2, b2 = two * (xy[k] - mx * my) + C2, xx[k] - mx * mx + yy[k] - my * my + C2
            inverse = one / (b1 * b2)
            value = a1 * a2 * inverse
            part += value
            by_xy, by_xx = scale * two * a1 * inverse, -scale * value * b1 * inverse
            mean_x[k] = scale * two * (my * a2 - mx * value * b2) * inverse - by_xy * my - two * by_xx * mx
            xx[k], xy[k] = by_xx, by_xy
        total += part
    return total


@kernel(fuse=True)
def add_up(x, y, by_mean, by_xx, by_xy, start, stop, absolute, out):
    """Write by_mean + 2 x by_xx + y by_xy + absolute sign(x - y) to out[start:stop]; returns the sum of |x - y|."""
    two, zero = np.float32(2.0), np.float32(0.0)
    total = 0.0
    for first_item in range(start, stop, BLOCK):
        part = np.float32(0.0)
        for k in range(first_item, min(first_item + BLOCK, stop)):
            off = x[k] - y[k]
            sign = (absolute if off > zero else zero) - (absolute if off < zero else zero)
            part += abs(off)
            out[k] = by_mean[k] + two * x[k] * by_xx[k] + y[k] * by_xy[k] + sign
        total += part
    return total


@kernel(fuse=True)
def map_colors(color, coverage, colors, background, start, stop, out):
    """Apply the color transform colors (3, 4) = [A b] to pixels start..stop and put them over the background.

    out (n, 3) = A C + b K + (1 - K) background, where C is the color times coverage and K the coverage.
    """
    for n in range(start, stop):
        x, y, z, shown = color[n, 0], color[n, 1], color[n, 2], coverage[n]
        left = np.float32(1.0) - shown
        for k in range(3):
            mapped = colors[k, 0] * x + colors[k, 1] * y + colors[k, 2] * z + colors[k, 3] * shown
            out[n, k] = mapped + left * background[k]


@kernel(fuse=True)
def map_colors_back(
    color, coverage, colors, background, by_mapped, start, stop, by_color, by_coverage, part, total
):
    """Derivatives w.r.t. C and K of pixels start..stop; adds those w.r.t. [A b] to total (12,); part (12,): scratch."""
    for first_item in range(start, stop, BLOCK):
        part[:] = 0.0
        for n in range(first_item, min(first_item + BLOCK, stop)):
            red, green, blue = by_mapped[n, 0], by_mapped[n, 1], by_mapped[n, 2]
            by_shown = np.float32(0.0)
            for k in range(3):
                by = by_mapped[n, k]
                by_color[n, k] = colors[0, k] * red + colors[1, k] * green + colors[2, k] * blue
                by_shown += by * (colors[k, 3] - background[k])
                part[4 * k] += by * color[n, 0]
                part[4 * k + 1] += by * color[n, 1]
                part[4 * k + 2] += by * color[n, 2]
                part[4 * k + 3] += by * coverage[n]
            by_coverage[n] = by_shown
        for k in range(12):
            total[k] += part[k]
