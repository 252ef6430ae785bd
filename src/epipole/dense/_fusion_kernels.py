"""Comparison of the depth of a view with that of other views, and normals."""

import numpy as np

from epipole._jit import kernel


@kernel
def compare_rows(own, other, motion, limits, start, stop, sums, counts):
    """Compare rows start..stop of a view with another view's depth.

    own = (depth, sigma, K (fx, fy, cx, cy), whether it contributes equal pixels), other = (depth, sigma, rgb, K), motion = (R (9), t (3)) from the view to
    the other, limits = (number of standard deviations, fraction of the depth). sums (h, w, 5) receives the sum of weights, of weighted
    depths, and of colors of agreeing views; counts (h, w, 3) the number of views that agree, that see through the point, and that agree with
    a smaller pixel, which then contributes the point.
    """
    depth, sigma, k, first = own
    other_depth, other_sigma, rgb, ko = other
    r, t = motion
    width, fraction = limits
    rows, columns = other_depth.shape
    for v in range(start, stop):
        for u in range(depth.shape[1]):
            z = depth[v, u]
            if not z > 0.0:
                continue
            x, y = (u - k[2]) / k[0] * z, (v - k[3]) / k[1] * z
            zo = r[6] * x + r[7] * y + r[8] * z + t[2]
            if not zo > 0.0:
                continue
            uo = ko[0] * (r[0] * x + r[1] * y + r[2] * z + t[0]) / zo + ko[2]
            vo = ko[1] * (r[3] * x + r[4] * y + r[5] * z + t[1]) / zo + ko[3]
            if not (uo > -0.5 and vo > -0.5 and uo < columns - 0.5 and vo < rows - 0.5):
                continue
            column, row = int(uo + 0.5), int(vo + 0.5)
            seen = other_depth[row, column]
            if not seen > 0.0:
                continue
            here, there = sigma[v, u] / z, other_sigma[row, column] / seen
            difference = (seen - zo) / zo
            if abs(difference) <= width * np.sqrt(here * here + there * there) + fraction:
                # The depth of this pixel that the other view's depth implies, to first order.
                weight = 1.0 / (there * there)
                sums[v, u, 0] += weight
                sums[v, u, 1] += weight * difference
                for c in range(3):
                    sums[v, u, 2 + c] += rgb[row, column, c]
                counts[v, u, 0] += 1
                mine, yours = z / k[0], zo / ko[0]
                if yours < mine or (yours == mine and not first):
                    counts[v, u, 2] += 1
            elif difference > 0.0:
                counts[v, u, 1] += 1


@kernel
def normal_rows(depth, k, reach, most_step, start, stop, out):
    """Unit normals (h, w, 3) of rows start..stop toward the camera; NaN where depth has a step or a hole.

    The cross product of differences over 2 reach pixels, from the nearest valid neighbors on both sides.
    """
    for v in range(start, stop):
        for u in range(depth.shape[1]):
            out[v, u, 0] = out[v, u, 1] = out[v, u, 2] = np.nan
            z = depth[v, u]
            if not z > 0.0:
                continue
            ax, ay, az = _difference(depth, k, v, u, 0, reach, most_step)
            bx, by, bz = _difference(depth, k, v, u, 1, reach, most_step)
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if not length > 0.0:
                continue
            toward = nx * (u - k[2]) / k[0] + ny * (v - k[3]) / k[1] + nz
            sign = -1.0 / length if toward > 0.0 else 1.0 / length
            out[v, u, 0], out[v, u, 1], out[v, u, 2] = sign * nx, sign * ny, sign * nz


@kernel
def _difference(depth, k, v, u, axis, reach, most_step):
    """Difference of the points on both sides along an axis (0: columns, 1: rows), at most `reach` pixels away; zero if there is none."""
    z = depth[v, u]
    low = high = 0
    for step in range(1, reach + 1):
        vb, ub = (v, u - step) if axis == 0 else (v - step, u)
        if vb >= 0 and ub >= 0 and abs(depth[vb, ub] - z) <= most_step * z and low == step - 1:
            low = step
        va, ua = (v, u + step) if axis == 0 else (v + step, u)
        if (
            va < depth.shape[0]
            and ua < depth.shape[1]
            and abs(depth[va, ua] - z) <= most_step * z
            and high == step - 1
        ):
            high = step
    if low + high == 0:
        return 0.0, 0.0, 0.0
    vb, ub = (v, u - low) if axis == 0 else (v - low, u)
    va, ua = (v, u + high) if axis == 0 else (v + high, u)
    zb, za = depth[vb, ub], depth[va, ua]
    return (
        (ua - k[2]) / k[0] * za - (ub - k[2]) / k[0] * zb,
        (va - k[3]) / k[1] * za - (vb - k[3]) / k[1] * zb,
        float(za - zb),
    )
