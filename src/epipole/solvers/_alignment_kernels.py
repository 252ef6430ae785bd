"""The motion or similarity between two triangles."""

import math

from epipole._jit import kernel

SCALE = 12  # index of the scale in a model, after R and t


@kernel
def _frame(p, out):
    """Orthonormal axes (columns) of a triangle (3, 3) of points; False if it is degenerate."""
    for i in range(3):
        out[i, 0], out[i, 1] = p[1, i] - p[0, i], p[2, i] - p[0, i]
    for c in range(2):
        before = math.sqrt(out[0, c] ** 2 + out[1, c] ** 2 + out[2, c] ** 2)
        if c == 1:
            dot = out[0, 0] * out[0, 1] + out[1, 0] * out[1, 1] + out[2, 0] * out[2, 1]
            for i in range(3):
                out[i, 1] -= dot * out[i, 0]
        norm = math.sqrt(out[0, c] ** 2 + out[1, c] ** 2 + out[2, c] ** 2)
        if not norm > 1e-6 * before:
            return False
        for i in range(3):
            out[i, c] /= norm
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i, 2] = out[j, 0] * out[k, 1] - out[k, 0] * out[j, 1]
    return True


@kernel
def align_three_points(x, y, has_scale, a, b, model):
    """The motion from triangle x to triangle y (Horn, JOSA A 1987, section 2); False if one is degenerate.

    The scale is the ratio of the triangles' sizes about their centroids.
    """
    if not (_frame(x, a) and _frame(y, b)):
        return False
    size_x, size_y = 0.0, 0.0
    for k in range(3):
        for i in range(3):
            size_x += (x[k, i] - (x[0, i] + x[1, i] + x[2, i]) / 3.0) ** 2
            size_y += (y[k, i] - (y[0, i] + y[1, i] + y[2, i]) / 3.0) ** 2
    scale = math.sqrt(size_y / size_x) if has_scale else 1.0
    for i in range(3):
        for j in range(3):
            model[3 * i + j] = b[i, 0] * a[j, 0] + b[i, 1] * a[j, 1] + b[i, 2] * a[j, 2]
    for i in range(3):
        model[9 + i] = 0.0
        for k in range(3):
            moved = model[3 * i] * x[k, 0] + model[3 * i + 1] * x[k, 1] + model[3 * i + 2] * x[k, 2]
            model[9 + i] += (y[k, i] - scale * moved) / 3.0
    model[SCALE] = scale
    return True
