"""Project Gaussians to ellipses in the image, and gradients back.

A Gaussian of mean m and covariance C = (R S)(R S)^T projects, linearized at its mean (Zwicker, Pfister, van Baar and
Gross, EWA volume splatting, 2001), to an ellipse with
    x_cam = W m + t,    V = (J W) C (J W)^T + blur I,    J = d project / d x_cam,
and its alpha at offset d from the center is o exp(-d^T V^-1 d / 2). Alphas below 1/255 are skipped, which means
d^T V^-1 d > k = 2 ln(255 o). A row of `ellipses` has what blending needs (`ELLIPSE`). With conic V^-1 = [[a, b], [b,
c]]
    ln(alpha) / 8 = XX dx^2 + XY dx dy + YY dy^2 + PEAK,
    XX = -a / 16,    XY = -b / 8,    YY = -c / 16,    PEAK = ln(o) / 8,
and the pixels of the ellipse in a row at offset dy are those within
    x - (b / a) dy +- sqrt(k / a - (a c - b^2) / a^2 dy^2),    |dy| <= sqrt(k V_yy),
with the rightmost one at dy = RIGHTMOST = -(b / a) V_yy sqrt(k / V_xx) and the leftmost one at -RIGHTMOST.
Colors are max(0, 1/2 + sum of harmonics). Derivatives follow these equations backward, one Gaussian at a time, so that
no two threads add to the same number.
"""

import math

from epipole._jit import kernel

X, Y, XX, XY, YY, PEAK, RED, GREEN, BLUE, DEPTH, HALF_HEIGHT, SLOPE, REACH, NARROWING, RIGHTMOST = range(15)
ELLIPSE = 16
"""Floats of a row: one cache line."""
LEAST_ALPHA = 1.0 / 255.0
WIDEST = 1.3
"""Limit of the half field of view at which the Jacobian is clamped, as the linearization degrades beyond it."""
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
def axes_of(log_scale, quat):
    """R S of a Gaussian, row-major."""
    w, x, y, z = float(quat[0]), float(quat[1]), float(quat[2]), float(quat[3])
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    s0, s1, s2 = math.exp(log_scale[0]), math.exp(log_scale[1]), math.exp(log_scale[2])
    return (
        (1.0 - 2.0 * (y * y + z * z)) * s0,
        2.0 * (x * y - w * z) * s1,
        2.0 * (x * z + w * y) * s2,
        2.0 * (x * y + w * z) * s0,
        (1.0 - 2.0 * (x * x + z * z)) * s1,
        2.0 * (y * z - w * x) * s2,
        2.0 * (x * z - w * y) * s0,
        2.0 * (y * z + w * x) * s1,
        (1.0 - 2.0 * (x * x + y * y)) * s2,
    )


@kernel(fuse=True)
def covariance_of(axes):
    """Axes axes^T as (xx, xy, xz, yy, yz, zz)."""
    a, b, c, d, e, f, g, h, i = axes
    return (
        a * a + b * b + c * c,
        a * d + b * e + c * f,
        a * g + b * h + c * i,
        d * d + e * e + f * f,
        d * g + e * h + f * i,
        g * g + h * h + i * i,
    )


@kernel(fuse=True)
def in_camera(view, mean):
    """W m + t."""
    r, t = view.rotation, view.translation
    x, y, z = float(mean[0]), float(mean[1]), float(mean[2])
    return (
        r[0] * x + r[1] * y + r[2] * z + t[0],
        r[3] * x + r[4] * y + r[5] * z + t[1],
        r[6] * x + r[7] * y + r[8] * z + t[2],
    )


@kernel(fuse=True)
def clamped_to_image(view, x, y, z):
    """Direction (x / z, y / z), clamped to the widest view, and whether each component was within it."""
    limit_u, limit_v = WIDEST * view.reach[0], WIDEST * view.reach[1]
    u, v = min(max(x / z, -limit_u), limit_u), min(max(y / z, -limit_v), limit_v)
    return u, v, abs(x) <= limit_u * z, abs(y) <= limit_v * z


@kernel(fuse=True)
def derivative_of_image(view, u, v, z):
    """J W, row-major, at depth z in direction (u, v, 1)."""
    ju, jv = view.focal[0] / z, view.focal[1] / z
    r = view.rotation
    return (
        ju * (r[0] - u * r[6]),
        ju * (r[1] - u * r[7]),
        ju * (r[2] - u * r[8]),
        jv * (r[3] - v * r[6]),
        jv * (r[4] - v * r[7]),
        jv * (r[5] - v * r[8]),
    )


@kernel(fuse=True)
def seen_covariance(jac, cov):
    """J C J^T as (xx, xy, yy)."""
    p, q, s, t, u, v = jac
    xx, xy, xz, yy, yz, zz = cov
    a0, a1, a2 = p * xx + q * xy + s * xz, p * xy + q * yy + s * yz, p * xz + q * yz + s * zz
    b0, b1, b2 = t * xx + u * xy + v * xz, t * xy + u * yy + v * yz, t * xz + u * yz + v * zz
    return a0 * p + a1 * q + a2 * s, a0 * t + a1 * u + a2 * v, b0 * t + b1 * u + b2 * v


@kernel
def project(view, cloud, shown, start, stop, ellipses, depths, basis):
    """Write rows start..stop of `ellipses` for visible Gaussians, and of `depths` (n,), which is 0 for invisible ones.

    shown (n,): factors of the opacities; basis (16,) is scratch.
    """
    count = cloud.sh.shape[1]
    for n in range(start, stop):
        row = ellipses[n]
        depths[n] = 0.0
        x, y, z = in_camera(view, cloud.means[n])
        opacity = shown[n] / (1.0 + math.exp(-float(cloud.logits[n])))
        if not (z > view.near_plane and opacity > LEAST_ALPHA):
            continue
        u, v, _, _ = clamped_to_image(view, x, y, z)
        jac = derivative_of_image(view, u, v, z)
        axes = axes_of(cloud.log_scales[n], cloud.quats_wxyz[n])
        vxx, vxy, vyy = seen_covariance(jac, covariance_of(axes))
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
        depths[n] = z
        row[X], row[Y], row[DEPTH], row[PEAK] = px, py, z, 0.125 * math.log(opacity)
        row[XX], row[XY], row[YY] = -0.0625 * a, -0.125 * b, -0.0625 * c
        row[SLOPE], row[REACH], row[NARROWING] = b / a, k / a, (a * c - b * b) / (a * a)
        row[HALF_HEIGHT], row[RIGHTMOST] = half_height, -b / a * half_height * half_height / half_width
        mean, center = cloud.means[n], view.center
        dx, dy, dz = mean[0] - center[0], mean[1] - center[1], mean[2] - center[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        harmonics(dx / length, dy / length, dz / length, count, basis)
        for channel in range(3):
            total = 0.5
            for i in range(count):
                total += basis[i] * cloud.sh[n, i, channel]
            row[RED + channel] = max(total, 0.0)


@kernel(fuse=True)
def by_direction(x, y, z, count, by_basis):
    """Derivative w.r.t. a unit direction, given that w.r.t. the harmonics."""
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
    return dx, dy, dz


@kernel(fuse=True)
def back_to_shape(quat, axes, by_cov, by_log_scale, by_quat):
    """Gradient w.r.t. log scales and quaternion from symmetric dL/dC = (xx, xy, xz, yy, yz, zz); axes = R S."""
    w, x, y, z = float(quat[0]), float(quat[1]), float(quat[2]), float(quat[3])
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    a0, b0, c0, a1, b1, c1, a2, b2, c2 = axes
    s0, g00, g10, g20 = _back_to_axis(by_cov, a0, a1, a2)
    s1, g01, g11, g21 = _back_to_axis(by_cov, b0, b1, b2)
    s2, g02, g12, g22 = _back_to_axis(by_cov, c0, c1, c2)
    by_log_scale[0], by_log_scale[1], by_log_scale[2] = s0, s1, s2
    dw = 2.0 * (x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01))
    dx = 2.0 * (y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12) - 2.0 * x * (g11 + g22))
    dy = 2.0 * (x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20) - 2.0 * y * (g00 + g22))
    dz = 2.0 * (x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01) - 2.0 * z * (g00 + g11))
    along = dw * w + dx * x + dy * y + dz * z
    by_quat[0], by_quat[1] = (dw - along * w) * inverse, (dx - along * x) * inverse
    by_quat[2], by_quat[3] = (dy - along * y) * inverse, (dz - along * z) * inverse


@kernel(fuse=True)
def _back_to_axis(by_cov, x, y, z):
    """DL/d(log length) of a column of R S, and dL/d of the column of R."""
    xx, xy, xz, yy, yz, zz = by_cov
    bx = 2.0 * (xx * x + xy * y + xz * z)
    by = 2.0 * (xy * x + yy * y + yz * z)
    bz = 2.0 * (xz * x + yz * y + zz * z)
    length = math.sqrt(x * x + y * y + z * z)
    return bx * x + by * y + bz * z, bx * length, by * length, bz * length
