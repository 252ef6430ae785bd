"""Gradients of Gaussians and pose from the tiles' sums; equations in `_projection_kernels` and `_blend_kernels`."""

import math

from epipole._jit import kernel
from epipole.fields.splat._projection_kernels import (
    axes_of,
    back_to_shape,
    by_direction,
    clamped_to_image,
    covariance_of,
    derivative_of_image,
    harmonics,
    in_camera,
    seen_covariance,
)
from epipole.fields.splat._simd_kernels import SUMS

G, GX, GXX, GY, GXY, GYY, BY_RED, BY_DEPTH = 0, 1, 2, 3, 4, 5, 6, 9


@kernel
def gather(view, cloud, ellipse, pair, by_pair, start, stop, gradient, by_pose, work):
    """Gradients of Gaussians start..stop; ellipse (n,) is the ellipse of each, -1 for none.

    `gradient` has the arrays of a cloud and `center`, dL/d(image position) in pixels. Adds the derivative w.r.t. xi in
    exp(xi) @ cam_from_world to by_pose (6,).
    """
    for n in range(start, stop):
        e = ellipse[n]
        if e < 0:
            continue
        _add_pairs(by_pair, pair[e], pair[e + 1], work.total)
        _one(view, cloud, n, gradient, n, by_pose, work)


@kernel(fuse=True)
def _add_pairs(by_pair, first, last, total):
    """Set total to the sum of rows first..last."""
    for k in range(SUMS):
        total[k] = 0.0
    for at in range(first, last):
        for k in range(SUMS):
            total[k] += by_pair[at, k]


@kernel(fuse=True)
def _by_ellipse(view, total, seen):
    """DL/d(px, py), and dL/dV as (xx, xy, yy) of a symmetric matrix, from the sums of g = dL/dpower, g dx, ..."""
    plain_xx, xy, plain_yy = seen
    xx, yy = plain_xx + view.blur, plain_yy + view.blur
    inverse = 1.0 / (xx * yy - xy * xy)
    a, b, c = yy * inverse, -xy * inverse, xx * inverse
    # dL/dV = -K G K, with K the conic and G = [[da, db / 2], [db / 2, dc]].
    ga, gb, gc = -0.5 * total[GXX], -0.5 * total[GXY], -0.5 * total[GYY]
    p, q = ga * a + gb * b, ga * b + gb * c
    r, s = gb * a + gc * b, gb * b + gc * c
    by_xx, by_xy, by_yy = -(a * p + b * r), -(a * q + b * s), -(b * q + c * s)
    plain = plain_xx * plain_yy - xy * xy
    if view.antialiased and plain > 0.0:
        half = 0.5 * total[G]
        by_xx += half * (plain_yy / plain - a)
        by_xy -= half * (xy / plain + b)
        by_yy += half * (plain_xx / plain - c)
    return a * total[GX] + b * total[GY], b * total[GX] + c * total[GY], (by_xx, by_xy, by_yy)


@kernel(fuse=True)
def _back_to_covariance(jac, by_seen):
    """V = T C T^T: dL/dC = T^T M T."""
    p, q, s, t, u, v = jac
    xx, xy, yy = by_seen
    a0, a1, a2 = xx * p + xy * t, xx * q + xy * u, xx * s + xy * v
    b0, b1, b2 = xy * p + yy * t, xy * q + yy * u, xy * s + yy * v
    return (
        p * a0 + t * b0,
        p * a1 + t * b1,
        p * a2 + t * b2,
        q * a1 + u * b1,
        q * a2 + u * b2,
        s * a2 + v * b2,
    )


@kernel(fuse=True)
def _back_to_derivative(jac, cov, by_seen):
    """dL/dT = 2 M T C, by rows."""
    p, q, s, t, u, v = jac
    xx, xy, xz, yy, yz, zz = cov
    m00, m01, m11 = 2.0 * by_seen[0], 2.0 * by_seen[1], 2.0 * by_seen[2]
    a0, a1, a2 = m00 * p + m01 * t, m00 * q + m01 * u, m00 * s + m01 * v
    b0, b1, b2 = m01 * p + m11 * t, m01 * q + m11 * u, m01 * s + m11 * v
    return (
        a0 * xx + a1 * xy + a2 * xz,
        a0 * xy + a1 * yy + a2 * yz,
        a0 * xz + a1 * yz + a2 * zz,
        b0 * xx + b1 * xy + b2 * xz,
        b0 * xy + b1 * yy + b2 * yz,
        b0 * xz + b1 * yz + b2 * zz,
    )


@kernel(fuse=True)
def _one(view, cloud, n, gradient, m, by_pose, work):
    """Write the gradient of Gaussian n, from the sums of its pairs, to row m of `gradient`."""
    total, r = work.total, view.rotation
    x, y, z = in_camera(view, cloud.means[n])
    u, v, free_u, free_v = clamped_to_image(view, x, y, z)
    jac = derivative_of_image(view, u, v, z)
    axes = axes_of(cloud.log_scales[n], cloud.quats_wxyz[n])
    cov = covariance_of(axes)
    by_px, by_py, by_seen = _by_ellipse(view, total, seen_covariance(jac, cov))
    gradient.center[m, 0], gradient.center[m, 1] = by_px, by_py
    gradient.logits[m] = total[G] * (1.0 - 1.0 / (1.0 + math.exp(-float(cloud.logits[n]))))
    back_to_shape(
        cloud.quats_wxyz[n],
        axes,
        _back_to_covariance(jac, by_seen),
        gradient.log_scales[m],
        gradient.quats_wxyz[m],
    )
    # T0 = ju (r0 - u r2) with ju = f / z, and T1 likewise.
    p0, p1, p2, q0, q1, q2 = _back_to_derivative(jac, cov, by_seen)
    ju, jv = view.focal[0] / z, view.focal[1] / z
    p_dot, q_dot = p0 * r[6] + p1 * r[7] + p2 * r[8], q0 * r[6] + q1 * r[7] + q2 * r[8]
    by_ju = p0 * r[0] + p1 * r[1] + p2 * r[2] - u * p_dot
    by_jv = q0 * r[3] + q1 * r[4] + q2 * r[5] - v * q_dot
    by_u = view.focal[0] * by_px - (ju * p_dot if free_u else 0.0)
    by_v = view.focal[1] * by_py - (jv * q_dot if free_v else 0.0)
    gx, gy = by_u / z, by_v / z
    gz = -(by_ju * ju + by_jv * jv + (by_u * x + by_v * y) / z) / z + total[BY_DEPTH]
    wx, wy, wz = _back_to_colors(view, cloud, n, gradient.sh[m], total, work)
    gradient.means[m, 0] = r[0] * gx + r[3] * gy + r[6] * gz + wx
    gradient.means[m, 1] = r[1] * gx + r[4] * gy + r[7] * gz + wy
    gradient.means[m, 2] = r[2] * gx + r[5] * gy + r[8] * gz + wz
    # Via the position in the camera frame, g and x cross g; via T, whose rows rotate with R, dR = [w]x R; and via the
    # camera center, which moves by -R^T of a translation.
    by_pose[0] += gx + r[0] * wx + r[1] * wy + r[2] * wz
    by_pose[1] += gy + r[3] * wx + r[4] * wy + r[5] * wz
    by_pose[2] += gz + r[6] * wx + r[7] * wy + r[8] * wz
    rows = (ju * p0, ju * p1, ju * p2, jv * q0, jv * q1, jv * q2)
    tx, ty, tz = _by_rotation(r, rows, u, v)
    by_pose[3] += y * gz - z * gy + tx
    by_pose[4] += z * gx - x * gz + ty
    by_pose[5] += x * gy - y * gx + tz


@kernel(fuse=True)
def _by_rotation(r, rows, u, v):
    """Sum over R's columns of column cross dL/d(column)."""
    wx = wy = wz = 0.0
    for k in range(3):
        d0, d1 = rows[k], rows[3 + k]
        d2 = -u * d0 - v * d1
        wx += r[3 + k] * d2 - r[6 + k] * d1
        wy += r[6 + k] * d0 - r[k] * d2
        wz += r[k] * d1 - r[3 + k] * d0
    return wx, wy, wz


@kernel(fuse=True)
def _back_to_colors(view, cloud, n, by_sh, total, work):
    """Gradient w.r.t. the SH coefficients, and w.r.t. the mean via the viewing direction."""
    count, basis, by_basis = cloud.sh.shape[1], work.basis, work.by_basis
    dx, dy, dz = (
        cloud.means[n, 0] - view.center[0],
        cloud.means[n, 1] - view.center[1],
        cloud.means[n, 2] - view.center[2],
    )
    inverse = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
    harmonics(dx, dy, dz, count, basis)
    sh = cloud.sh[n]
    red = green = blue = 0.5
    for i in range(count):
        red += basis[i] * sh[i, 0]
        green += basis[i] * sh[i, 1]
        blue += basis[i] * sh[i, 2]
    red = total[BY_RED] if red > 0.0 else 0.0
    green = total[BY_RED + 1] if green > 0.0 else 0.0
    blue = total[BY_RED + 2] if blue > 0.0 else 0.0
    for i in range(count):
        by_sh[i, 0], by_sh[i, 1], by_sh[i, 2] = basis[i] * red, basis[i] * green, basis[i] * blue
        by_basis[i] = sh[i, 0] * red + sh[i, 1] * green + sh[i, 2] * blue
    wx, wy, wz = by_direction(dx, dy, dz, count, by_basis)
    along = wx * dx + wy * dy + wz * dz
    return (wx - along * dx) * inverse, (wy - along * dy) * inverse, (wz - along * dz) * inverse
