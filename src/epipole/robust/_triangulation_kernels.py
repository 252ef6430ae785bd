"""Triangulation of calibrated views: two in closed form, more by hypotheses and refinement.

`rows` are the observations: image, pixel (k, 2) and ray (k, 3, unit, in camera coordinates). `cams` are the images:
motion = cam_from_world (R row by row, t), center, camera, and the cameras' model and params.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import (
    NUM_PARAMS,
    OPENCV_FISHEYE,
    expand_params,
    project_one,
    project_with_jacobian_one,
    unproject_one,
)

MAX_ROWS_TRIED = 10  # rows per point, evenly spread, from which pairs are tried
OK, TOO_FEW_VIEWS, SMALL_ANGLE, BEHIND_CAMERA, LARGE_ERROR = 0, 1, 2, 3, 4
FARTHEST = 1e3  # largest distance from the principal point, in focal lengths


class Rows(NamedTuple):
    """Observations, grouped by point."""

    image: np.ndarray
    pixel: np.ndarray
    ray: np.ndarray


class Cams(NamedTuple):
    """Poses and cameras of the views."""

    motion: np.ndarray
    center: np.ndarray
    camera: np.ndarray
    model: np.ndarray
    params: np.ndarray


@kernel
def error_sq(rows, cams, k, x, y, z):
    """Squared reprojection error of a point in row k; infinite behind the camera."""
    i = rows.image[k]
    m = cams.motion[i]
    c = cams.camera[i]
    u, v = project_one(
        np.int64(cams.model[c]),
        cams.params[c],
        m[0] * x + m[1] * y + m[2] * z + m[9],
        m[3] * x + m[4] * y + m[5] * z + m[10],
        m[6] * x + m[7] * y + m[8] * z + m[11],
    )
    r = (u - rows.pixel[k, 0]) ** 2 + (v - rows.pixel[k, 1]) ** 2
    return r if r >= 0.0 else math.inf


@kernel
def cosine_at(cams, i, j, x):
    """Cosine of the angle at x between the centers of images i and j."""
    a, b = cams.center[i], cams.center[j]
    dot, na, nb = 0.0, 0.0, 0.0
    for c in range(3):
        p, q = a[c] - x[c], b[c] - x[c]
        dot += p * q
        na += p * p
        nb += q * q
    return dot / math.sqrt(na * nb + 1e-300)


@kernel
def world_ray(rows, cams, k, out):
    """Unit direction of row k in world coordinates."""
    m, r = cams.motion[rows.image[k]], rows.ray[k]
    for c in range(3):
        out[c] = m[c] * r[0] + m[3 + c] * r[1] + m[6 + c] * r[2]


@kernel
def midpoint(rows, cams, k, l, a, b, x):
    """Write the midpoint between the rays of two rows to x; False if they are parallel or it is behind a camera."""
    world_ray(rows, cams, k, a)
    world_ray(rows, cams, l, b)
    p, q = cams.center[rows.image[k]], cams.center[rows.image[l]]
    cos, ta, tb = 0.0, 0.0, 0.0
    for c in range(3):
        t = q[c] - p[c]
        cos += a[c] * b[c]
        ta += a[c] * t
        tb += b[c] * t
    sin_sq = 1.0 - cos * cos
    if sin_sq < 1e-12:
        return False
    along_a, along_b = (ta - cos * tb) / sin_sq, (cos * ta - tb) / sin_sq
    if not (along_a > 0.0 and along_b > 0.0):
        return False
    for c in range(3):
        x[c] = 0.5 * (p[c] + along_a * a[c] + q[c] + along_b * b[c])
    return True


@kernel
def collect_inliers(rows, cams, free, count, x, max_error_sq, chosen):
    """The best row of each image that sees x within the bound; returns their number and the sum of errors."""
    found, total = 0, 0.0
    for n in range(count):
        k = free[n]
        e = error_sq(rows, cams, k, x[0], x[1], x[2])
        if not e < max_error_sq:
            continue
        twin = -1
        for m in range(found):
            if rows.image[chosen[m]] == rows.image[k]:
                twin = m
        if twin < 0:
            chosen[found] = k
            found += 1
            total += e
        else:
            before = error_sq(rows, cams, chosen[twin], x[0], x[1], x[2])
            if e < before:
                chosen[twin] = k
                total += e - before
    return found, total


@kernel
def polish_point(rows, cams, chosen, count, x, jac, jac_params):
    """Gauss-Newton on the reprojection error of the chosen rows, in place."""
    for _ in range(5):
        a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        gx, gy, gz = 0.0, 0.0, 0.0
        for n in range(count):
            k = chosen[n]
            i = rows.image[k]
            m = cams.motion[i]
            cam = cams.camera[i]
            u, v = project_with_jacobian_one(
                np.int64(cams.model[cam]),
                cams.params[cam],
                m[0] * x[0] + m[1] * x[1] + m[2] * x[2] + m[9],
                m[3] * x[0] + m[4] * x[1] + m[5] * x[2] + m[10],
                m[6] * x[0] + m[7] * x[1] + m[8] * x[2] + m[11],
                jac,
                jac_params,
            )
            if not (u - u == 0.0):
                return
            for s in range(2):
                r = (u - rows.pixel[k, 0]) if s == 0 else (v - rows.pixel[k, 1])
                jx = jac[s, 0] * m[0] + jac[s, 1] * m[3] + jac[s, 2] * m[6]
                jy = jac[s, 0] * m[1] + jac[s, 1] * m[4] + jac[s, 2] * m[7]
                jz = jac[s, 0] * m[2] + jac[s, 1] * m[5] + jac[s, 2] * m[8]
                a += jx * jx
                b += jx * jy
                c += jx * jz
                d += jy * jy
                e += jy * jz
                f += jz * jz
                gx += jx * r
                gy += jy * r
                gz += jz * r
        p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
        det = a * p + b * q + c * r
        if not det > 1e-300:
            return
        dx = (p * gx + q * gy + r * gz) / det
        dy = (q * gx + (a * f - c * c) * gy + (b * c - a * e) * gz) / det
        dz = (r * gx + (b * c - a * e) * gy + (a * d - b * b) * gz) / det
        x[0] -= dx
        x[1] -= dy
        x[2] -= dz
        if dx * dx + dy * dy + dz * dz < 1e-16 * (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]):
            return


@kernel
def min_cosine(rows, cams, chosen, count, x):
    """Cosine of the largest angle between chosen rows at x."""
    least = 1.0
    for n in range(count):
        for m in range(n):
            least = min(least, cosine_at(cams, rows.image[chosen[n]], rows.image[chosen[m]], x))
    return least


@kernel
def best_hypothesis(rows, cams, free, count, max_error_sq, max_cosine, work, best_x):
    """The pair of rows whose midpoint most rows agree with; returns the number of agreeing rows."""
    a, b, x, chosen = work
    best, best_total = 0, math.inf
    step = max(1, (count + MAX_ROWS_TRIED - 1) // MAX_ROWS_TRIED)
    for n in range(0, count, step):
        for m in range(0, n, step):
            k, l = free[n], free[m]
            if rows.image[k] == rows.image[l] or not midpoint(rows, cams, k, l, a, b, x):
                continue
            if cosine_at(cams, rows.image[k], rows.image[l], x) > max_cosine:
                continue
            found, total = collect_inliers(rows, cams, free, count, x, max_error_sq, chosen)
            if found > best or (found == best and total < best_total):
                best, best_total = found, total
                for c in range(3):
                    best_x[c] = x[c]
            if best == count and best_total < 0.25 * max_error_sq * count:
                return best
    return best


@kernel
def plain_camera(model, params, f):
    """Whether a camera has no distortion, its principal point, and the factors from its pixels to a focal length f."""
    fx, fy, cx, cy, d0, d1, d2, d3 = expand_params(model, params)
    is_plain = model < OPENCV_FISHEYE and d0 == 0.0 and d1 == 0.0 and d2 == 0.0 and d3 == 0.0
    return is_plain, cx, cy, f / fx, f / fy


@kernel(inline=True)
def without_distortion(camera, model, params, f, u, v):
    """The pixel in a pinhole camera of focal length f, relative to its principal point; NaN if behind the camera."""
    is_plain, cx, cy, sx, sy = camera
    if is_plain:
        a, b = sx * (u - cx), sy * (v - cy)
    else:
        x, y, z = unproject_one(model, params, u, v)
        per_z = f / z if z > 0.0 else math.nan
        a, b = per_z * x, per_z * y
    return a, b


@kernel(allocates=True)
def triangulate_two_views(
    models, params, motion, essential, focal, max_cosine, pixels1, pixels2, start, stop, out
):
    """Triangulate points start..stop with the least sum of squared reprojection errors in both images.

    Lindstrom (CVPR 2010), table 3 (niter2): with x2^T E x1 = 0, both points move to each other's epipolar line by lambda n,
    twice, and then meet. Coordinates are undistorted pixels relative to the principal point, so both images have equal weight.
    `out` = (points in camera 1, errors, cosines, reasons).
    """
    points, errors, cosines, reasons = out
    f1, f2 = focal[0], focal[1]
    per_f1, per_f2 = 1.0 / f1, 1.0 / f2
    camera1, camera2 = plain_camera(models[0], params[0], f1), plain_camera(models[1], params[1], f2)
    e = essential
    e00, e01, e02 = e[0] / (f1 * f2), e[1] / (f1 * f2), e[2] / f2
    e10, e11, e12 = e[3] / (f1 * f2), e[4] / (f1 * f2), e[5] / f2
    e20, e21, e22 = e[6] / f1, e[7] / f1, e[8]
    r = motion
    for k in range(start, stop):
        points[k, 0] = points[k, 1] = points[k, 2] = math.nan
        errors[k], cosines[k] = math.inf, 1.0
        a0, a1 = without_distortion(camera1, models[0], params[0], f1, pixels1[k, 0], pixels1[k, 1])
        b0, b1 = without_distortion(camera2, models[1], params[1], f2, pixels2[k, 0], pixels2[k, 1])
        if not (a0 * a0 + a1 * a1 < (FARTHEST * f1) ** 2 and b0 * b0 + b1 * b1 < (FARTHEST * f2) ** 2):
            reasons[k] = TOO_FEW_VIEWS
            continue
        # n2: normal of x1's line in image 2; n1: normal of x2's line in image 1.
        n20, n21 = e00 * a0 + e01 * a1 + e02, e10 * a0 + e11 * a1 + e12
        n10, n11 = e00 * b0 + e10 * b1 + e20, e01 * b0 + e11 * b1 + e21
        a = n20 * (e00 * n10 + e01 * n11) + n21 * (e10 * n10 + e11 * n11)
        b = 0.5 * (n20 * n20 + n21 * n21 + n10 * n10 + n11 * n11)
        c = b0 * n20 + b1 * n21 + e20 * a0 + e21 * a1 + e22
        d = math.sqrt(max(b * b - a * c, 0.0))
        step = c / (b + d + 1e-300)
        d20, d21, d10, d11 = step * n20, step * n21, step * n10, step * n11
        m20, m21 = n20 - (e00 * d10 + e01 * d11), n21 - (e10 * d10 + e11 * d11)
        m10, m11 = n10 - (e00 * d20 + e10 * d21), n11 - (e01 * d20 + e11 * d21)
        step *= 2.0 * d / (m20 * m20 + m21 * m21 + m10 * m10 + m11 * m11 + 1e-300)
        d20, d21, d10, d11 = step * m20, step * m21, step * m10, step * m11
        errors[k] = math.sqrt(0.25 * (d20 * d20 + d21 * d21 + d10 * d10 + d11 * d11))
        x, y = (a0 - d10) * per_f1, (a1 - d11) * per_f1
        u, v = (b0 - d20) * per_f2, (b1 - d21) * per_f2
        p, q, s = r[0] * x + r[1] * y + r[2], r[3] * x + r[4] * y + r[5], r[6] * x + r[7] * y + r[8]
        # X1 = depth (x, y, 1): depth R x1 + t is parallel to x2, so depth (x2 x R x1) = -(x2 x t).
        z0, z1, z2 = v * s - q, p - u * s, u * q - v * p
        t0, t1, t2 = v * r[11] - r[10], r[9] - u * r[11], u * r[10] - v * r[9]
        sine_sq = z0 * z0 + z1 * z1 + z2 * z2
        lengths = (p * p + q * q + s * s) * (u * u + v * v + 1.0)
        dot = p * u + q * v + s
        cosine = dot / math.sqrt(lengths)
        cosines[k] = cosine
        if not (cosine <= max_cosine and sine_sq > 1e-24 * lengths):
            reasons[k] = SMALL_ANGLE
            continue
        depth = -(z0 * t0 + z1 * t1 + z2 * t2) / sine_sq
        points[k, 0], points[k, 1], points[k, 2] = depth * x, depth * y, depth
        reasons[k] = OK if depth > 0.0 and depth * s + r[11] > 0.0 else BEHIND_CAMERA


@kernel(allocates=True)
def triangulate_many_views(rows, cams, offsets, start, stop, max_error_sq, max_cosine, longest, out, keep):
    """Triangulate points start..stop: the pair of views that most others agree with, then Gauss-Newton over its inliers.

    `out` = (points in the world, errors, cosines, reasons); `keep` marks the inlier rows.
    """
    points, errors, cosines, reasons = out
    free, chosen, x = np.empty(longest, np.int64), np.empty(longest, np.int64), np.empty(3)
    work = (np.empty(3), np.empty(3), np.empty(3), np.empty(longest, np.int64))
    jac, jac_params = np.empty((2, 3)), np.empty((2, NUM_PARAMS))
    for j in range(start, stop):
        points[j, 0] = points[j, 1] = points[j, 2] = math.nan
        errors[j], cosines[j] = math.inf, 1.0
        count = np.int64(0)  # a literal would compile the callees twice
        for k in range(offsets[j], offsets[j + 1]):
            keep[k] = False
            if math.isfinite(rows.ray[k, 0]):
                free[count] = k
                count += 1
        if count < 2:
            reasons[j] = TOO_FEW_VIEWS
            continue
        if best_hypothesis(rows, cams, free, count, max_error_sq, max_cosine, work, x) < 2:
            # Find the reason by relaxing the bounds on error and angle.
            if best_hypothesis(rows, cams, free, count, math.inf, 2.0, work, x) < 2:
                reasons[j] = BEHIND_CAMERA
            elif best_hypothesis(rows, cams, free, count, max_error_sq, 2.0, work, x) < 2:
                reasons[j] = LARGE_ERROR
            else:
                reasons[j] = SMALL_ANGLE
            continue
        found, _ = collect_inliers(rows, cams, free, count, x, max_error_sq, chosen)
        polish_point(rows, cams, chosen, found, x, jac, jac_params)
        found, total = collect_inliers(rows, cams, free, count, x, max_error_sq, chosen)
        if found < 2:
            reasons[j] = LARGE_ERROR
            continue
        cosines[j] = min_cosine(rows, cams, chosen, found, x)
        errors[j] = math.sqrt(0.5 * total / found)
        reasons[j] = OK if cosines[j] <= max_cosine else SMALL_ANGLE
        for c in range(3):
            points[j, c] = x[c]
        for n in range(found):
            keep[chosen[n]] = True
