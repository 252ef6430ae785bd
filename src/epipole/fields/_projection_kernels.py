"""Gaussians as ellipses of a picture, and the way back of gradients.

A Gaussian of mean m and covariance C = (R S)(R S)^T is seen, to first order about its middle (Zwicker, Pfister, van Baar and
Gross, EWA volume splatting, 2001), as an ellipse with
    x_cam = W m + t,    V = (J W) C (J W)^T + blur I,    J = d project / d x_cam,
and its alpha at a pixel that is d off is o exp(-d^T V^-1 d / 2). What is below 1/255 is not drawn: that is where
d^T V^-1 d > k = 2 ln(255 o). A row of `ellipses` holds what blending needs (`ELLIPSE`); with the conic V^-1 = [[a, b], [b, c]] the
ellipse's pixels of a row that is dy off are those within
    x - (b / a) dy +- sqrt(k / a - (a c - b^2) / a^2 dy^2),    |dy| <= sqrt(k V_yy).
Colours are max(0, 1/2 + sum of harmonics); derivatives follow the equations backwards, Gaussian by Gaussian, so that nothing is
added by two threads.
"""

import math

from epipole._jit import kernel

X, Y, A, B, C, OPACITY, RED, GREEN, BLUE, DEPTH, HALF_HEIGHT, SLOPE, REACH, NARROWING, HALF_WIDTH = range(15)
ELLIPSE = 16
"""Numbers of a row: one cache line."""
LEAST_ALPHA = 1.0 / 255.0
WIDEST = 1.3
"""Times the half view: beyond it the derivative is taken at the rim, where the projection is not yet wild."""
SH1, SH2A, SH2B, SH2C = 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
SH3A, SH3B, SH3C = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
SH3D, SH3E = 0.3731763325901154, 1.445305721320277
SH0 = 0.28209479177387814


@kernel(fuse=True)
def harmonics(x, y, z, count, basis):
    """The first 1, 4, 9 or 16 real spherical harmonics of a direction, in the order and with the signs of 3DGS."""
    basis[0] = SH0
    if count > 1:
        basis[1], basis[2], basis[3] = -SH1 * y, SH1 * z, -SH1 * x
    if count > 4:
        basis[4], basis[5], basis[6] = SH2A * x * y, -SH2A * y * z, SH2B * (2.0 * z * z - x * x - y * y)
        basis[7], basis[8] = -SH2A * x * z, SH2C * (x * x - y * y)
    if count > 9:
        basis[9], basis[10] = -SH3A * y * (3.0 * x * x - y * y), SH3B * x * y * z
        basis[11] = -SH3C * y * (4.0 * z * z - x * x - y * y)
        basis[12] = SH3D * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)
        basis[13] = -SH3C * x * (4.0 * z * z - x * x - y * y)
        basis[14], basis[15] = SH3E * z * (x * x - y * y), -SH3A * x * (x * x - 3.0 * y * y)


@kernel(fuse=True)
def covariance(log_scale, quat, axes, out):
    """Axes = R S (3, 3) and C = axes axes^T as (xx, xy, xz, yy, yz, zz)."""
    w, x, y, z = float(quat[0]), float(quat[1]), float(quat[2]), float(quat[3])
    length = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    s0, s1, s2 = math.exp(log_scale[0]), math.exp(log_scale[1]), math.exp(log_scale[2])
    axes[0, 0], axes[0, 1], axes[0, 2] = (
        (1.0 - 2.0 * (y * y + z * z)) * s0,
        2.0 * (x * y - w * z) * s1,
        2.0 * (x * z + w * y) * s2,
    )
    axes[1, 0], axes[1, 1], axes[1, 2] = (
        2.0 * (x * y + w * z) * s0,
        (1.0 - 2.0 * (x * x + z * z)) * s1,
        2.0 * (y * z - w * x) * s2,
    )
    axes[2, 0], axes[2, 1], axes[2, 2] = (
        2.0 * (x * z - w * y) * s0,
        2.0 * (y * z + w * x) * s1,
        (1.0 - 2.0 * (x * x + y * y)) * s2,
    )
    at = 0
    for i in range(3):
        for j in range(i, 3):
            out[at] = axes[i, 0] * axes[j, 0] + axes[i, 1] * axes[j, 1] + axes[i, 2] * axes[j, 2]
            at += 1


@kernel(fuse=True)
def in_picture(view, x, y, z, jac):
    """Rows of J W (2, 3) at a point in the camera, held within the widest view; whether x, and y, were held."""
    inverse = 1.0 / z
    u, v = x * inverse, y * inverse
    limit_u, limit_v = WIDEST * view.reach[0], WIDEST * view.reach[1]
    held_u, held_v = min(max(u, -limit_u), limit_u), min(max(v, -limit_v), limit_v)
    ju, jv = view.focal[0] * inverse, view.focal[1] * inverse
    r = view.rotation
    for k in range(3):
        jac[0, k] = ju * (r[k] - held_u * r[6 + k])
        jac[1, k] = jv * (r[3 + k] - held_v * r[6 + k])
    return held_u, held_v


@kernel
def project(view, cloud, start, stop, ellipses, work):
    """Fill rows start..stop of `ellipses`; OPACITY is 0 for what is not seen."""
    axes, cov, jac, basis = work
    r, t = view.rotation, view.translation
    count = cloud.sh.shape[1]
    for n in range(start, stop):
        row = ellipses[n]
        row[OPACITY] = 0.0
        mx, my, mz = float(cloud.means[n, 0]), float(cloud.means[n, 1]), float(cloud.means[n, 2])
        x = r[0] * mx + r[1] * my + r[2] * mz + t[0]
        y = r[3] * mx + r[4] * my + r[5] * mz + t[1]
        z = r[6] * mx + r[7] * my + r[8] * mz + t[2]
        if not z > view.near_plane:
            continue
        opacity = 1.0 / (1.0 + math.exp(-float(cloud.logits[n])))
        covariance(cloud.log_scales[n], cloud.quats_wxyz[n], axes, cov)
        in_picture(view, x, y, z, jac)
        vxx, vxy, vyy = seen_covariance(jac, cov)
        plain = vxx * vyy - vxy * vxy
        vxx, vyy = vxx + view.blur, vyy + view.blur
        det = vxx * vyy - vxy * vxy
        if not (det > 0.0 and det < math.inf):
            continue
        if view.antialiased:
            opacity *= math.sqrt(max(plain, 0.0) / det)
        if not opacity > LEAST_ALPHA:
            continue
        k = 2.0 * math.log(opacity / LEAST_ALPHA)
        px = view.focal[0] * x / z + view.middle[0]
        py = view.focal[1] * y / z + view.middle[1]
        half_width, half_height = math.sqrt(k * vxx), math.sqrt(k * vyy)
        if not (
            px + half_width >= 0.0
            and px - half_width <= view.width - 1.0
            and py + half_height >= 0.0
            and py - half_height <= view.height - 1.0
        ):
            continue
        a, b, c = vyy / det, -vxy / det, vxx / det
        row[X], row[Y], row[A], row[B], row[C], row[OPACITY] = px, py, a, b, c, opacity
        row[DEPTH], row[HALF_HEIGHT], row[HALF_WIDTH] = z, half_height, half_width
        row[SLOPE], row[REACH], row[NARROWING] = b / a, k / a, (a * c - b * b) / (a * a)
        dx, dy, dz = mx - view.center[0], my - view.center[1], mz - view.center[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        harmonics(dx / length, dy / length, dz / length, count, basis)
        for channel in range(3):
            total = 0.5
            for i in range(count):
                total += basis[i] * cloud.sh[n, i, channel]
            row[RED + channel] = max(total, 0.0)


@kernel(fuse=True)
def seen_covariance(jac, cov):
    """Upper half of J C J^T."""
    a0 = jac[0, 0] * cov[0] + jac[0, 1] * cov[1] + jac[0, 2] * cov[2]
    a1 = jac[0, 0] * cov[1] + jac[0, 1] * cov[3] + jac[0, 2] * cov[4]
    a2 = jac[0, 0] * cov[2] + jac[0, 1] * cov[4] + jac[0, 2] * cov[5]
    b0 = jac[1, 0] * cov[0] + jac[1, 1] * cov[1] + jac[1, 2] * cov[2]
    b1 = jac[1, 0] * cov[1] + jac[1, 1] * cov[3] + jac[1, 2] * cov[4]
    b2 = jac[1, 0] * cov[2] + jac[1, 1] * cov[4] + jac[1, 2] * cov[5]
    return (
        a0 * jac[0, 0] + a1 * jac[0, 1] + a2 * jac[0, 2],
        a0 * jac[1, 0] + a1 * jac[1, 1] + a2 * jac[1, 2],
        b0 * jac[1, 0] + b1 * jac[1, 1] + b2 * jac[1, 2],
    )


@kernel(fuse=True)
def add_direction(x, y, z, count, by_basis, out):
    """Out += derivative by a unit direction, with dL/dharmonics."""
    g = by_basis
    dx = dy = dz = 0.0
    if count > 1:
        dx, dy, dz = -SH1 * g[3], -SH1 * g[1], SH1 * g[2]
    if count > 4:
        dx += SH2A * (y * g[4] - z * g[7]) - 2.0 * SH2B * x * g[6] + 2.0 * SH2C * x * g[8]
        dy += SH2A * (x * g[4] - z * g[5]) - 2.0 * SH2B * y * g[6] - 2.0 * SH2C * y * g[8]
        dz += -SH2A * (y * g[5] + x * g[7]) + 4.0 * SH2B * z * g[6]
    if count > 9:
        xx, yy, zz = x * x, y * y, z * z
        dx += -6.0 * SH3A * x * y * g[9] + SH3B * y * z * g[10] + 2.0 * SH3C * x * y * g[11]
        dx += -6.0 * SH3D * x * z * g[12] - SH3C * (4.0 * zz - 3.0 * xx - yy) * g[13]
        dx += 2.0 * SH3E * x * z * g[14] - 3.0 * SH3A * (xx - yy) * g[15]
        dy += (
            -3.0 * SH3A * (xx - yy) * g[9] + SH3B * x * z * g[10] - SH3C * (4.0 * zz - xx - 3.0 * yy) * g[11]
        )
        dy += -6.0 * SH3D * y * z * g[12] + 2.0 * SH3C * x * y * g[13]
        dy += -2.0 * SH3E * y * z * g[14] + 6.0 * SH3A * x * y * g[15]
        dz += (
            SH3B * x * y * g[10]
            - 8.0 * SH3C * y * z * g[11]
            + SH3D * (6.0 * zz - 3.0 * xx - 3.0 * yy) * g[12]
        )
        dz += -8.0 * SH3C * x * z * g[13] + SH3E * (xx - yy) * g[14]
    out[0] += dx
    out[1] += dy
    out[2] += dz


@kernel(fuse=True)
def back_to_shape(quat, axes, by_cov, g, by_log_scale, by_quat):
    """From dL/dC, a symmetric matrix (3, 3), to logarithms of deviations and quaternion; axes = R S, g (3, 3) is scratch."""
    w, x, y, z = float(quat[0]), float(quat[1]), float(quat[2]), float(quat[3])
    length = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    for j in range(3):
        scale = math.sqrt(axes[0, j] * axes[0, j] + axes[1, j] * axes[1, j] + axes[2, j] * axes[2, j])
        total = 0.0
        for i in range(3):
            by_axis = 2.0 * (
                by_cov[i, 0] * axes[0, j] + by_cov[i, 1] * axes[1, j] + by_cov[i, 2] * axes[2, j]
            )
            total += by_axis * axes[i, j]
            g[i, j] = by_axis * scale
        by_log_scale[j] = total
    dw = 2.0 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    dx = 2.0 * (
        y * (g[0, 1] + g[1, 0])
        + z * (g[0, 2] + g[2, 0])
        + w * (g[2, 1] - g[1, 2])
        - 2.0 * x * (g[1, 1] + g[2, 2])
    )
    dy = 2.0 * (
        x * (g[0, 1] + g[1, 0])
        + z * (g[1, 2] + g[2, 1])
        + w * (g[0, 2] - g[2, 0])
        - 2.0 * y * (g[0, 0] + g[2, 2])
    )
    dz = 2.0 * (
        x * (g[0, 2] + g[2, 0])
        + y * (g[1, 2] + g[2, 1])
        + w * (g[1, 0] - g[0, 1])
        - 2.0 * z * (g[0, 0] + g[1, 1])
    )
    along = dw * w + dx * x + dy * y + dz * z
    by_quat[0], by_quat[1] = (dw - along * w) / length, (dx - along * x) / length
    by_quat[2], by_quat[3] = (dy - along * y) / length, (dz - along * z) / length
