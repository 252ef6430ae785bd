"""Projection and unprojection of single points, with Jacobians, for every model.

Perspective family (Brown 1971; OpenCV's order of coefficients): a = x/z, b = y/z, r2 = a^2 + b^2,
    u = fx (a (1 + k1 r2 + k2 r2^2) + 2 p1 a b + p2 (r2 + 2 a^2)) + cx        v likewise.
FULL_OPENCV replaces the bracket by (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3).
Fisheye (Kannala and Brandt 2006): theta = angle to the optical axis, rho = |(x, y)|,
    u = fx theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) x / rho + cx.
Points must be in front of the camera (perspective) or differ from its center (fisheye).
"""

import math

import numpy as np

from epipole._jit import kernel

SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, OPENCV_FISHEYE, FULL_OPENCV = 0, 1, 2, 3, 4, 5, 6
NUM_PARAMS = 12
MIN_DEPTH = 1e-12


@kernel
def expand_params(model, params):
    """Any model's parameters as (fx, fy, cx, cy, d0, d1, d2, d3) of the OPENCV or OPENCV_FISHEYE form.

    FULL_OPENCV has more parameters, and separate branches.
    """
    if model == PINHOLE or model >= OPENCV:
        if model == PINHOLE:
            return params[0], params[1], params[2], params[3], 0.0, 0.0, 0.0, 0.0
        return params[0], params[1], params[2], params[3], params[4], params[5], params[6], params[7]
    k1 = params[3] if model != SIMPLE_PINHOLE else 0.0
    k2 = params[4] if model == RADIAL else 0.0
    return params[0], params[0], params[1], params[2], k1, k2, 0.0, 0.0


@kernel
def rational_factor(params, r2):
    """FULL_OPENCV's radial factor s(r2), ds/d(r2), and its denominator."""
    above = 1.0 + r2 * (params[4] + r2 * (params[5] + r2 * params[8]))
    below = 1.0 + r2 * (params[9] + r2 * (params[10] + r2 * params[11]))
    above_slope = params[4] + r2 * (2.0 * params[5] + r2 * 3.0 * params[8])
    below_slope = params[9] + r2 * (2.0 * params[10] + r2 * 3.0 * params[11])
    s = above / below
    return s, (above_slope - s * below_slope) / below, below


@kernel
def distort_full_with_jacobian(params, a, b):
    """(u, v, du/da, du/db = dv/da, dv/db) of FULL_OPENCV's distortion on the plane z = 1."""
    r2 = a * a + b * b
    s, slope, _ = rational_factor(params, r2)
    p1, p2 = params[6], params[7]
    u = a * s + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
    v = b * s + 2.0 * p2 * a * b + p1 * (r2 + 2.0 * b * b)
    ua = s + 2.0 * a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
    ub = 2.0 * a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
    vb = s + 2.0 * b * b * slope + 2.0 * p2 * a + 6.0 * p1 * b
    return u, v, ua, ub, vb


@kernel
def full_params_jacobian(params, a, b, jac_params):
    """d(u, v)/d(params) of FULL_OPENCV at (a, b) on the plane z = 1, into jac_params (2, 12)."""
    fx, fy = params[0], params[1]
    r2 = a * a + b * b
    s, _, below = rational_factor(params, r2)
    u, v, _, _, _ = distort_full_with_jacobian(params, a, b)
    jac_params[0, 0], jac_params[1, 1] = u, v
    jac_params[0, 2] = jac_params[1, 3] = 1.0
    power = r2 / below
    for c in range(3):
        own, other = 8 if c == 2 else 4 + c, 9 + c
        jac_params[0, own], jac_params[1, own] = fx * a * power, fy * b * power
        jac_params[0, other], jac_params[1, other] = -fx * a * s * power, -fy * b * s * power
        power *= r2
    jac_params[0, 6], jac_params[1, 6] = fx * 2.0 * a * b, fy * (r2 + 2.0 * b * b)
    jac_params[0, 7], jac_params[1, 7] = fx * (r2 + 2.0 * a * a), fy * 2.0 * a * b


@kernel
def undistort_full(params, p, q):
    """(a, b) whose FULL_OPENCV distortion is (p, q), before the distortion folds; NaN if there is none.

    Steps along the radius until the target is passed, then Newton's method in two dimensions.
    """
    target, r, reached = math.sqrt(p * p + q * q), 0.0, 0.0
    while reached < target:
        r += 0.02
        s, slope, _ = rational_factor(params, r * r)
        if not s + 2.0 * r * r * slope > 0.0 or r > 50.0:
            return math.nan, math.nan
        reached = r * s
    scale = r / target if target > 0.0 else 0.0
    a, b = scale * p, scale * q
    for _ in range(30):
        u, v, ua, ub, vb = distort_full_with_jacobian(params, a, b)
        eu, ev = u - p, v - q
        det = ua * vb - ub * ub
        if det < 1e-6:
            return math.nan, math.nan
        a -= (vb * eu - ub * ev) / det
        b -= (ua * ev - ub * eu) / det
        if abs(eu) + abs(ev) < 1e-14:
            break
    u, v, _, _, _ = distort_full_with_jacobian(params, a, b)
    if not abs(u - p) + abs(v - q) < 1e-9:
        return math.nan, math.nan
    return a, b


@kernel
def project_one(model, params, x, y, z):
    """Pixel (u, v) of a point in camera coordinates; NaN if the camera cannot see it."""
    fx, fy, cx, cy, d0, d1, d2, d3 = expand_params(model, params)
    if model == OPENCV_FISHEYE:
        rho = math.sqrt(x * x + y * y)
        if rho <= 1e-12 * abs(z):
            if z <= 0.0:
                return math.nan, math.nan
            return cx + fx * x / z, cy + fy * y / z
        theta = math.atan2(rho, z)
        t2 = theta * theta
        scale = theta * (1.0 + t2 * (d0 + t2 * (d1 + t2 * (d2 + t2 * d3)))) / rho
        return fx * scale * x + cx, fy * scale * y + cy
    if z < MIN_DEPTH:
        return math.nan, math.nan
    a, b = x / z, y / z
    if model == FULL_OPENCV:
        u, v, _, _, _ = distort_full_with_jacobian(params, a, b)
        return fx * u + cx, fy * v + cy
    r2 = a * a + b * b
    radial = 1.0 + r2 * (d0 + r2 * d1)
    u = a * radial + 2.0 * d2 * a * b + d3 * (r2 + 2.0 * a * a)
    v = b * radial + 2.0 * d3 * a * b + d2 * (r2 + 2.0 * b * b)
    return fx * u + cx, fy * v + cy


@kernel
def distort_with_jacobian(d0, d1, d2, d3, a, b):
    """(u, v, du/da, du/db = dv/da, dv/db) of the perspective distortion on the plane z = 1."""
    r2 = a * a + b * b
    radial = 1.0 + r2 * (d0 + r2 * d1)
    slope = 2.0 * (d0 + 2.0 * r2 * d1)
    u = a * radial + 2.0 * d2 * a * b + d3 * (r2 + 2.0 * a * a)
    v = b * radial + 2.0 * d3 * a * b + d2 * (r2 + 2.0 * b * b)
    ua = radial + a * a * slope + 2.0 * d2 * b + 6.0 * d3 * a
    ub = a * b * slope + 2.0 * d2 * a + 2.0 * d3 * b
    vb = radial + b * b * slope + 2.0 * d3 * a + 6.0 * d2 * b
    return u, v, ua, ub, vb


@kernel
def project_with_jacobian_one(model, params, x, y, z, jac_point, jac_params):
    """Pixel (u, v), d(u, v)/d(x, y, z) into jac_point (2, 3) and d(u, v)/d(params) into jac_params (2, 12)."""
    fx, fy, cx, cy, d0, d1, d2, d3 = expand_params(model, params)
    for c in range(NUM_PARAMS):  # faster than setting a slice
        jac_params[0, c] = jac_params[1, c] = 0.0
    if model == OPENCV_FISHEYE:
        rho2 = x * x + y * y
        rho = math.sqrt(rho2)
        if rho <= 1e-12 * abs(z) and z <= 0.0:
            return math.nan, math.nan
        r2 = rho2 + z * z
        theta = math.atan2(rho, z)
        t2 = theta * theta
        poly = 1.0 + t2 * (d0 + t2 * (d1 + t2 * (d2 + t2 * d3)))
        slope = 1.0 + t2 * (3.0 * d0 + t2 * (5.0 * d1 + t2 * (7.0 * d2 + t2 * 9.0 * d3)))
        if rho < 1e-9 * z:
            s, ds_rho, ds_z, theta_rho = 1.0 / z, 0.0, -1.0 / (z * z), 1.0 / z
        else:
            theta_rho = theta / rho
            s = theta_rho * poly
            ds_rho = (slope * z / r2 - s) / rho2  # ds/drho / rho, so that ds/dx = ds_rho * x
            ds_z = -slope / r2
        u, v = s * x, s * y
        jac_point[0, 0] = fx * (s + x * x * ds_rho)
        jac_point[0, 1] = fx * x * y * ds_rho
        jac_point[0, 2] = fx * x * ds_z
        jac_point[1, 0] = fy * x * y * ds_rho
        jac_point[1, 1] = fy * (s + y * y * ds_rho)
        jac_point[1, 2] = fy * y * ds_z
        jac_params[0, 0], jac_params[1, 1] = u, v
        jac_params[0, 2] = jac_params[1, 3] = 1.0
        power = theta_rho
        for c in range(4, 8):
            power *= t2
            jac_params[0, c], jac_params[1, c] = fx * x * power, fy * y * power
        return fx * u + cx, fy * v + cy
    if z < MIN_DEPTH:
        return math.nan, math.nan
    iz = 1.0 / z
    a, b = x * iz, y * iz
    if model == FULL_OPENCV:
        u, v, ua, ub, vb = distort_full_with_jacobian(params, a, b)
        full_params_jacobian(params, a, b, jac_params)
    else:
        u, v, ua, ub, vb = distort_with_jacobian(d0, d1, d2, d3, a, b)
    jac_point[0, 0] = fx * ua * iz
    jac_point[0, 1] = fx * ub * iz
    jac_point[0, 2] = -fx * (ua * a + ub * b) * iz
    jac_point[1, 0] = fy * ub * iz
    jac_point[1, 1] = fy * vb * iz
    jac_point[1, 2] = -fy * (ub * a + vb * b) * iz
    r2 = a * a + b * b
    if model == PINHOLE or model == OPENCV:
        jac_params[0, 0], jac_params[1, 1] = u, v
        jac_params[0, 2] = jac_params[1, 3] = 1.0
        if model == OPENCV:
            jac_params[0, 4], jac_params[1, 4] = fx * a * r2, fy * b * r2
            jac_params[0, 5], jac_params[1, 5] = fx * a * r2 * r2, fy * b * r2 * r2
            jac_params[0, 6], jac_params[1, 6] = fx * 2.0 * a * b, fy * (r2 + 2.0 * b * b)
            jac_params[0, 7], jac_params[1, 7] = fx * (r2 + 2.0 * a * a), fy * 2.0 * a * b
    elif model != FULL_OPENCV:
        jac_params[0, 0], jac_params[1, 0] = u, v
        jac_params[0, 1] = jac_params[1, 2] = 1.0
        if model != SIMPLE_PINHOLE:
            jac_params[0, 3], jac_params[1, 3] = fx * a * r2, fy * b * r2
        if model == RADIAL:
            jac_params[0, 4], jac_params[1, 4] = fx * a * r2 * r2, fy * b * r2 * r2
    return fx * u + cx, fy * v + cy


@kernel
def fold_radius(d0, d1):
    """The first r > 0 with d(r (1 + d0 r^2 + d1 r^4))/dr = 0, where the distortion folds; infinity if there is none."""
    root = 9.0 * d0 * d0 - 20.0 * d1
    inverse_sq = 0.5 * (math.sqrt(root) - 3.0 * d0) if root >= 0.0 else 0.0
    return 1.0 / math.sqrt(inverse_sq) if inverse_sq > 0.0 else math.inf


@kernel
def undistorted_radius(d0, d1, fold, target):
    """The r before the fold with r (1 + d0 r^2 + d1 r^4) = target > 0; close to the fold if there is none.

    Newton's method, with bisection if it would leave the bracket.
    """
    low, high = 0.0, fold
    if not high < math.inf:
        high = max(1.0, target)
        while high * (1.0 + high * high * (d0 + high * high * d1)) < target:
            high *= 2.0
    r = min(target, high)
    for _ in range(60):
        r2 = r * r
        error = r * (1.0 + r2 * (d0 + r2 * d1)) - target
        if error > 0.0:
            high = r
        else:
            low = r
        slope = 1.0 + r2 * (3.0 * d0 + r2 * 5.0 * d1)
        following = r - error / slope if slope > 0.0 else high
        if not low < following < high:
            following = 0.5 * (low + high)
        if abs(following - r) <= 1e-12 * r:  # the caller polishes
            break
        r = following
    return r


@kernel
def unproject_one(model, params, u, v):
    """Unit direction (x, y, z) that projects to (u, v); NaN if Newton's method finds none."""
    fx, fy, cx, cy, d0, d1, d2, d3 = expand_params(model, params)
    p, q = (u - cx) / fx, (v - cy) / fy
    if model == OPENCV_FISHEYE:
        target = math.sqrt(p * p + q * q)
        if target < 1e-12:
            n = 1.0 / math.sqrt(p * p + q * q + 1.0)
            return p * n, q * n, n
        theta = min(target, 1.5)
        for _ in range(30):
            t2 = theta * theta
            error = theta * (1.0 + t2 * (d0 + t2 * (d1 + t2 * (d2 + t2 * d3)))) - target
            slope = 1.0 + t2 * (3.0 * d0 + t2 * (5.0 * d1 + t2 * (7.0 * d2 + t2 * 9.0 * d3)))
            if slope < 1e-6:
                return math.nan, math.nan, math.nan
            theta -= error / slope
            if abs(error) < 1e-14:
                break
        t2 = theta * theta
        error = theta * (1.0 + t2 * (d0 + t2 * (d1 + t2 * (d2 + t2 * d3)))) - target
        if not (abs(error) < 1e-9 and 0.0 <= theta <= math.pi):
            return math.nan, math.nan, math.nan
        s = math.sin(theta) / target
        return p * s, q * s, math.cos(theta)
    a, b = p, q
    if model == FULL_OPENCV:
        a, b = undistort_full(params, p, q)
    elif d0 != 0.0 or d1 != 0.0 or d2 != 0.0 or d3 != 0.0:
        # There are wrong roots beyond the fold: start before it, and stay there.
        fold = fold_radius(d0, d1)
        target = math.sqrt(p * p + q * q)
        if target > 0.0:
            ratio = undistorted_radius(d0, d1, fold, target) / target
            a, b = ratio * p, ratio * q
        for _ in range(30):
            du, dv, ua, ub, vb = distort_with_jacobian(d0, d1, d2, d3, a, b)
            eu, ev = du - p, dv - q
            det = ua * vb - ub * ub
            # A zero or negative determinant means that the distortion folds here.
            if det < 1e-6:
                return math.nan, math.nan, math.nan
            a -= (vb * eu - ub * ev) / det
            b -= (ua * ev - ub * eu) / det
            if abs(eu) + abs(ev) < 1e-14:
                break
        du, dv, ua, ub, vb = distort_with_jacobian(d0, d1, d2, d3, a, b)
        if not (abs(du - p) + abs(dv - q) < 1e-9 and math.sqrt(a * a + b * b) < 1.05 * fold):
            return math.nan, math.nan, math.nan
    n = 1.0 / math.sqrt(a * a + b * b + 1.0)
    return a * n, b * n, n


@kernel
def project_all(model, params, points, out):
    """Rows of points (n, 3) -> pixels out (n, 2)."""
    for k in range(len(points)):
        out[k, 0], out[k, 1] = project_one(model, params, points[k, 0], points[k, 1], points[k, 2])


@kernel
def project_with_jacobian_all(model, params, points, out, jac_points, jac_params):
    """Like project_all, with jac_points (n, 2, 3) and jac_params (n, 2, 12)."""
    for k in range(len(points)):
        out[k, 0], out[k, 1] = project_with_jacobian_one(
            model, params, points[k, 0], points[k, 1], points[k, 2], jac_points[k], jac_params[k]
        )
        if not np.isfinite(out[k, 0]):
            jac_points[k, :, :] = math.nan
            jac_params[k, :, :] = math.nan


@kernel
def unproject_all(model, params, pixels, out):
    """Rows of pixels (n, 2) -> unit directions out (n, 3)."""
    for k in range(len(pixels)):
        out[k, 0], out[k, 1], out[k, 2] = unproject_one(model, params, pixels[k, 0], pixels[k, 1])
