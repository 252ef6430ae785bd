"""Weighted least squares along rows and columns in turn (Min et al., Fast global image smoothing, TIP 2014).

Each line minimizes sum_i w_i (u_i - f_i)^2 + lambda sum_i e_i (u_i - u_i+1)^2, a tridiagonal system solved by elimination (Thomas).
w is zero for unknown pixels, e is small across image edges.
"""

import numpy as np

from epipole._jit import kernel


@kernel
def solve_line(weights, values, links, strength, upper, out):
    """Solve one line: u from values f with weights w, smoothness strength * links between neighbors."""
    n = len(values)
    before, ahead, right = 0.0, 0.0, 0.0
    for i in range(n):
        weight_before = strength * links[i - 1] if i > 0 else 0.0
        constraint = strength * links[i] if i < n - 1 else 0.0
        diagonal = weights[i] + weight_before + constraint - weight_before * before
        right = weights[i] * values[i] + weight_before * ahead
        inverse = 1.0 / max(diagonal, 1e-12)
        before, ahead = constraint * inverse, right * inverse
        upper[i], out[i] = before, ahead
    for i in range(n - 2, -1, -1):
        out[i] += upper[i] * out[i + 1]


@kernel(allocates=True)
def smooth_rows(weights, values, links, strength, start, stop):
    """Smooth rows start..stop of values and weights (h, w) in place."""
    width = values.shape[1]
    upper, sums, fractions, ones = np.empty(width), np.empty(width), np.empty(width), np.ones(width)
    for y in range(start, stop):
        # Numerator and denominator are smoothed alike, so that a line without known values stays unknown.
        solve_line(ones, values[y], links[y], strength, upper, sums)
        solve_line(ones, weights[y], links[y], strength, upper, fractions)
        for x in range(width):
            values[y, x], weights[y, x] = sums[x], fractions[x]
