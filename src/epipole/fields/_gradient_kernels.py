"""From the sums that the tiles wrote, back to Gaussians and the camera; equations in `_projection_kernels` and `_blend_kernels`."""

import math

from epipole._jit import kernel
from epipole.fields._projection_kernels import (
    add_direction,
    back_to_shape,
    covariance,
    harmonics,
    in_picture,
    seen_covariance,
)
from epipole.fields._simd_kernels import SUMS

G, GX, GXX, GY, GXY, GYY, BY_RED, BY_DEPTH = 0, 1, 2, 3, 4, 5, 6, 9


@kernel(fuse=True)
def _add_pairs(by_pair, first, last, total):
    """Total = sum of the rows first..last."""
    for k in range(SUMS):
        total[k] = 0.0
    for at in range(first, last):
        for k in range(SUMS):
            total[k] += by_pair[at, k]


@kernel(fuse=True)
def _by_ellipse(view, total, v, plain, by_v):
    """From dL/dconic to dL/dV = (xx, xy, yy), with the sums g, g dx, ... of power's derivatives; returns dL/d(px, py)."""
    det = v[0] * v[2] - v[1] * v[1]
    a, b, c = v[2] / det, -v[1] / det, v[0] / det
    # dL/dV = -K G K, with K the conic and G = [[da, db / 2], [db / 2, dc]].
    ga, gb, gc = -0.5 * total[GXX], -0.5 * total[GXY], -0.5 * total[GYY]
    p, q = ga * a + gb * b, ga * b + gb * c
    r, s = gb * a + gc * b, gb * b + gc * c
    by_v[0], by_v[1], by_v[2] = -(a * p + b * r), -2.0 * (a * q + b * s), -(b * q + c * s)
    if view.antialiased and plain > 0.0:
        half = 0.5 * total[G]
        by_v[0] += half * ((v[2] - view.blur) / plain - v[2] / det)
        by_v[1] += -2.0 * half * (v[1] / plain - v[1] / det)
        by_v[2] += half * ((v[0] - view.blur) / plain - v[0] / det)
    return a * total[GX] + b * total[GY], b * total[GX] + c * total[GY]


@kernel
def gather(view, cloud, gaussian, pair, by_pair, start, stop, gradient, by_pose, work):
    """Gradients of the Gaussians of the ellipses start..stop; by_pose (6,) += that of xi in exp(xi) @ cam_from_world.

    `gradient` has the arrays of a cloud, and `center`: dL/d of where each is seen, in pixels.
    """
    axes, cov, jac, basis, total, v, by_v, by_jac, by_cov, by_basis, by_mean, scratch = work
    r, t = view.rotation, view.translation
    count = cloud.sh.shape[1]
    for e in range(start, stop):
        n = gaussian[e]
        _add_pairs(by_pair, pair[e], pair[e + 1], total)
        mx, my, mz = float(cloud.means[n, 0]), float(cloud.means[n, 1]), float(cloud.means[n, 2])
        x = r[0] * mx + r[1] * my + r[2] * mz + t[0]
        y = r[3] * mx + r[4] * my + r[5] * mz + t[1]
        z = r[6] * mx + r[7] * my + r[8] * mz + t[2]
        covariance(cloud.log_scales[n], cloud.quats_wxyz[n], axes, cov)
        held_u, held_v = in_picture(view, x, y, z, jac)
        v[0], v[1], v[2] = seen_covariance(jac, cov)
        plain = v[0] * v[2] - v[1] * v[1]
        v[0], v[2] = v[0] + view.blur, v[2] + view.blur
        by_px, by_py = _by_ellipse(view, total, v, plain, by_v)
        gradient.center[n, 0], gradient.center[n, 1] = by_px, by_py
        opacity = 1.0 / (1.0 + math.exp(-float(cloud.logits[n])))
        gradient.logits[n] = total[G] * (1.0 - opacity)
        # V = T C T^T: dL/dC = T^T M T, dL/dT = 2 M T C.
        m00, m01, m11 = by_v[0], 0.5 * by_v[1], by_v[2]
        for k in range(3):
            p = m00 * jac[0, k] + m01 * jac[1, k]
            q = m01 * jac[0, k] + m11 * jac[1, k]
            for i in range(3):
                by_cov[i, k] = jac[0, i] * p + jac[1, i] * q
        for k in range(3):
            c0, c1, c2 = _column(cov, k)
            p = jac[0, 0] * c0 + jac[0, 1] * c1 + jac[0, 2] * c2
            q = jac[1, 0] * c0 + jac[1, 1] * c1 + jac[1, 2] * c2
            by_jac[0, k] = 2.0 * (m00 * p + m01 * q)
            by_jac[1, k] = 2.0 * (m01 * p + m11 * q)
        back_to_shape(
            cloud.quats_wxyz[n], axes, by_cov, scratch, gradient.log_scales[n], gradient.quats_wxyz[n]
        )
        # T0 = ju (r0 - u r2) with ju = f / z, and the like for T1.
        ju, jv = view.focal[0] / z, view.focal[1] / z
        by_ju = by_jv = by_u = by_vv = 0.0
        for k in range(3):
            by_ju += by_jac[0, k] * (r[k] - held_u * r[6 + k])
            by_jv += by_jac[1, k] * (r[3 + k] - held_v * r[6 + k])
            by_u -= ju * by_jac[0, k] * r[6 + k]
            by_vv -= jv * by_jac[1, k] * r[6 + k]
        if held_u != x * (1.0 / z):
            by_u = 0.0
        if held_v != y * (1.0 / z):
            by_vv = 0.0
        by_u += view.focal[0] * by_px
        by_vv += view.focal[1] * by_py
        gx, gy = by_u / z, by_vv / z
        gz = -(by_ju * ju + by_jv * jv + by_u * x / z + by_vv * y / z) / z + total[BY_DEPTH]
        # Colours, by coefficients and by the direction from which they are seen.
        dx, dy, dz = mx - view.center[0], my - view.center[1], mz - view.center[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / length, dy / length, dz / length
        harmonics(dx, dy, dz, count, basis)
        for i in range(count):
            by_basis[i] = 0.0
        for channel in range(3):
            colour = 0.5
            for i in range(count):
                colour += basis[i] * cloud.sh[n, i, channel]
            by_colour = total[BY_RED + channel] if colour > 0.0 else 0.0
            for i in range(count):
                gradient.sh[n, i, channel] = basis[i] * by_colour
                by_basis[i] += cloud.sh[n, i, channel] * by_colour
        by_mean[0] = by_mean[1] = by_mean[2] = 0.0
        add_direction(dx, dy, dz, count, by_basis, by_mean)
        along = by_mean[0] * dx + by_mean[1] * dy + by_mean[2] * dz
        wx, wy, wz = (
            (by_mean[0] - along * dx) / length,
            (by_mean[1] - along * dy) / length,
            (by_mean[2] - along * dz) / length,
        )
        gradient.means[n, 0] = r[0] * gx + r[3] * gy + r[6] * gz + wx
        gradient.means[n, 1] = r[1] * gx + r[4] * gy + r[7] * gz + wy
        gradient.means[n, 2] = r[2] * gx + r[5] * gy + r[8] * gz + wz
        _add_pose(view, x, y, z, gx, gy, gz, by_jac, ju, jv, held_u, held_v, by_pose)
        # The camera's centre moves by -R^T of a shift.
        by_pose[0] += r[0] * wx + r[1] * wy + r[2] * wz
        by_pose[1] += r[3] * wx + r[4] * wy + r[5] * wz
        by_pose[2] += r[6] * wx + r[7] * wy + r[8] * wz


@kernel(fuse=True)
def _column(cov, k):
    """Column k of the symmetric matrix (xx, xy, xz, yy, yz, zz)."""
    if k == 0:
        return cov[0], cov[1], cov[2]
    if k == 1:
        return cov[1], cov[3], cov[4]
    return cov[2], cov[4], cov[5]


@kernel(fuse=True)
def _add_pose(view, x, y, z, gx, gy, gz, by_jac, ju, jv, held_u, held_v, out):
    """Through the place in the camera, g and x cross g; and through T, whose rows turn with R: dR = [w]x R."""
    r = view.rotation
    out[0] += gx
    out[1] += gy
    out[2] += gz
    wx, wy, wz = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
    for k in range(3):
        r0, r1, r2 = r[k], r[3 + k], r[6 + k]
        d0, d1 = ju * by_jac[0, k], jv * by_jac[1, k]
        d2 = -held_u * d0 - held_v * d1
        wx += r1 * d2 - r2 * d1
        wy += r2 * d0 - r0 * d2
        wz += r0 * d1 - r1 * d0
    out[3] += wx
    out[4] += wy
    out[5] += wz
