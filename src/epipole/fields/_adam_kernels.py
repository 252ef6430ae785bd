"""Adam (Kingma and Ba, ICLR 2015) for the rows that a picture has seen."""

import math

import numpy as np

from epipole._jit import kernel

MOMENTUM, SQUARES = np.float32(0.9), np.float32(0.99)
LEAST = np.float32(1e-15)


@kernel
def adam_rows(values, gradient, mean, square, seen, start, stop, rates, unbias):
    """Move the rows start..stop of values (n, k) that are `seen` (n,), by rates (k,); mean and square are Adam's, (n, k).

    unbias (2,): 1 / (1 - beta^t) of mean and square.
    """
    one = np.float32(1.0)
    for n in range(start, stop):
        if not seen[n]:
            continue
        for k in range(values.shape[1]):
            g = gradient[n, k]
            m = MOMENTUM * mean[n, k] + (one - MOMENTUM) * g
            v = SQUARES * square[n, k] + (one - SQUARES) * g * g
            mean[n, k], square[n, k] = m, v
            values[n, k] -= rates[k] * m * unbias[0] / (np.float32(math.sqrt(v * unbias[1])) + LEAST)
