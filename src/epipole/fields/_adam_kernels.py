"""Adam (Kingma and Ba, ICLR 2015): one step of one number, and of arrays of them.

m = b1 m + (1 - b1) g;  v = b2 v + (1 - b2) g^2;  x -= rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)
`splat/_simd_kernels.adam_row` is the same for 16 numbers at once.
"""

import math

import numpy as np

from epipole._jit import kernel

MOMENTUM, SQUARES, LEAST = np.float32(0.9), np.float32(0.99), np.float32(1e-15)
"""b1, b2 and eps."""


@kernel(fuse=True)
def move_number(k, values, g, mean, square, rate, unbias):
    """Adam step of number k with gradient g; unbias (2,) is 1 / (1 - b^t) of both moments."""
    one = np.float32(1.0)
    m = MOMENTUM * mean[k] + (one - MOMENTUM) * g
    v = SQUARES * square[k] + (one - SQUARES) * g * g
    mean[k], square[k] = m, v
    values[k] -= rate * m * unbias[0] / (np.float32(math.sqrt(v * unbias[1])) + LEAST)


@kernel(fuse=True)
def move_all(values, gradient, mean, square, rate, unbias):
    """Adam step of flat arrays."""
    for k in range(values.size):
        move_number(k, values, gradient[k], mean, square, rate, unbias)


@kernel
def move_touched(values, gradient, mean, square, rate, unbias):
    """Adam step of the numbers of flat arrays with a nonzero gradient, which is cleared."""
    for k in range(len(values)):
        if gradient[k] != np.float32(0.0):
            move_number(k, values, gradient[k], mean, square, rate, unbias)
            gradient[k] = np.float32(0.0)


@kernel
def move_gaussians(cloud, gradient, is_visible, start, stop, adam):
    """Adam step of the visible Gaussians among start..stop."""
    mean, square, rates, unbias = adam.mean, adam.square, adam.rates, adam.unbias
    for n in range(start, stop):
        if not is_visible[n]:
            continue
        move_all(cloud.means[n], gradient.means[n], mean.means[n], square.means[n], rates[0], unbias)
        move_all(
            cloud.log_scales[n],
            gradient.log_scales[n],
            mean.log_scales[n],
            square.log_scales[n],
            rates[1],
            unbias,
        )
        move_all(
            cloud.quats_wxyz[n],
            gradient.quats_wxyz[n],
            mean.quats_wxyz[n],
            square.quats_wxyz[n],
            rates[2],
            unbias,
        )
        move_number(n, cloud.logits, gradient.logits[n], mean.logits, square.logits, rates[3], unbias)
        move_all(cloud.sh[n, 0], gradient.sh[n, 0], mean.sh[n, 0], square.sh[n, 0], rates[4], unbias)
        if cloud.sh.shape[1] > 1:
            move_all(
                cloud.sh[n, 1:].reshape(-1),
                gradient.sh[n, 1:].reshape(-1),
                mean.sh[n, 1:].reshape(-1),
                square.sh[n, 1:].reshape(-1),
                rates[5],
                unbias,
            )
