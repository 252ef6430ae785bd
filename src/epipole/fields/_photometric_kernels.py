"""The likeness of two pictures and its derivative, pixel by pixel, between the blurs that SSIM is made of."""

import numpy as np

from epipole._jit import kernel

C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
"""Wang, Bovik, Sheikh and Simoncelli, IEEE TIP 2004, of values from 0 to 1."""


@kernel(fuse=True)
def ssim_terms(mean_x, mean_y, xx, yy, xy, scale):
    """SSIM of flat rows of blurred x, y, x x, y y and x y, which are overwritten.

    mean_x, xx and xy get `scale` times d SSIM / d of the blurred x, x x and x y; returns the sum of SSIM.
    """
    one, two = np.float32(1.0), np.float32(2.0)
    total = 0.0
    for k in range(mean_x.size):
        mx, my = mean_x[k], mean_y[k]
        a1, b1 = two * mx * my + C1, mx * mx + my * my + C1
        a2, b2 = two * (xy[k] - mx * my) + C2, xx[k] - mx * mx + yy[k] - my * my + C2
        inverse = one / (b1 * b2)
        value = a1 * a2 * inverse
        total += value
        by_xy, by_xx = scale * two * a1 * inverse, -scale * value / b2
        mean_x[k] = scale * two * (my * a2 - mx * value * b2) * inverse - by_xy * my - two * by_xx * mx
        xx[k], xy[k] = by_xx, by_xy
    return total


@kernel(fuse=True)
def add_up(x, y, by_mean, by_xx, by_xy, absolute, out):
    """Out = by_mean + 2 x by_xx + y by_xy + absolute sign(x - y), flat; returns the sum of |x - y|."""
    two, zero = np.float32(2.0), np.float32(0.0)
    total = 0.0
    for k in range(x.size):
        off = x[k] - y[k]
        sign = absolute if off > zero else (-absolute if off < zero else zero)
        total += abs(off)
        out[k] = by_mean[k] + two * x[k] * by_xx[k] + y[k] * by_xy[k] + sign
    return total
