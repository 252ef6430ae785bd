"""Residuals, scores and normal equations of the robust estimators.

Every score is MSAC's sum of min(r^2, T^2) (Torr and Zisserman, CVIU 2000). Matches are rows u1, v1, u2, v2 of
a (4, n) array, so that the loops over matches vectorise.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import project_one, project_with_jacobian_one

BLOCK = 128
# `reassoc` lets the sum over a block vectorise (measured 4 times faster); the order of summation stays fixed.
REASSOC = frozenset({"reassoc"})


@kernel(extra_fastmath=REASSOC)
def sampson_block(f, m, start, stop, threshold_sq):
    """MSAC sum over matches start..stop of the squared Sampson distance."""
    total = 0.0
    for k in range(start, stop):
        a, b, c, d = m[0, k], m[1, k], m[2, k], m[3, k]
        l0 = f[0] * a + f[1] * b + f[2]
        l1 = f[3] * a + f[4] * b + f[5]
        l2 = f[6] * a + f[7] * b + f[8]
        g0 = f[0] * c + f[3] * d + f[6]
        g1 = f[1] * c + f[4] * d + f[7]
        e = c * l0 + d * l1 + l2
        r = e * e / (l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300)
        total += r if r < threshold_sq else threshold_sq
    return total


@kernel
def sampson_score(f, m, threshold_sq, bail_out):
    """MSAC score of F (or E); stops once it exceeds bail_out."""
    n, total = m.shape[1], 0.0
    for start in range(0, n, BLOCK):
        total += sampson_block(f, m, start, min(start + BLOCK, n), threshold_sq)
        if total > bail_out:
            return total
    return total


@kernel
def sampson_all(f, m, out):
    """Squared Sampson distance of every match."""
    for k in range(m.shape[1]):
        a, b, c, d = m[0, k], m[1, k], m[2, k], m[3, k]
        l0, l1 = f[0] * a + f[1] * b + f[2], f[3] * a + f[4] * b + f[5]
        e = c * l0 + d * l1 + f[6] * a + f[7] * b + f[8]
        g0, g1 = f[0] * c + f[3] * d + f[6], f[1] * c + f[4] * d + f[7]
        out[k] = e * e / (l0 * l0 + l1 * l1 + g0 * g0 + g1 * g1 + 1e-300)


@kernel(allocates=True)
def sampson_normal_equations(f, m, threshold_sq, a9, b9):
    """Gauss-Newton terms in the nine entries of F over the matches within the threshold; returns the score.

    r = e / sqrt(n), e = x2^T F x1, n = |(F x1)_12|^2 + |(F^T x2)_12|^2, so that
    dr/dF_ij = (x2_i x1_j - (e / n) ([i<2] (F x1)_i x1_j + [j<2] (F^T x2)_j x2_i)) / sqrt(n).
    """
    a9[:, :] = 0.0
    b9[:] = 0.0
    g = np.empty(9)
    x1, x2, l, h = np.ones(3), np.ones(3), np.zeros(3), np.zeros(3)
    total = 0.0
    for k in range(m.shape[1]):
        x1[0], x1[1], x2[0], x2[1] = m[0, k], m[1, k], m[2, k], m[3, k]
        l[0], l[1] = f[0] * x1[0] + f[1] * x1[1] + f[2], f[3] * x1[0] + f[4] * x1[1] + f[5]
        e = x2[0] * l[0] + x2[1] * l[1] + f[6] * x1[0] + f[7] * x1[1] + f[8]
        h[0], h[1] = f[0] * x2[0] + f[3] * x2[1] + f[6], f[1] * x2[0] + f[4] * x2[1] + f[7]
        n = l[0] * l[0] + l[1] * l[1] + h[0] * h[0] + h[1] * h[1] + 1e-300
        if not e * e < threshold_sq * n:
            total += threshold_sq
            continue
        total += e * e / n
        inv, ratio = 1.0 / math.sqrt(n), e / n
        r = e * inv
        for i in range(3):
            for j in range(3):
                g[3 * i + j] = inv * (x2[i] * x1[j] - ratio * (l[i] * x1[j] + h[j] * x2[i]))
        for i in range(9):
            b9[i] += g[i] * r
            for j in range(i + 1):
                a9[i, j] += g[i] * g[j]
    for i in range(9):
        for j in range(i):
            a9[j, i] = a9[i, j]
    return total


@kernel(extra_fastmath=REASSOC)
def transfer_block(h, m, start, stop, threshold_sq):
    """MSAC sum over matches start..stop of the squared transfer error in image 2."""
    total = 0.0
    for k in range(start, stop):
        a, b = m[0, k], m[1, k]
        w = 1.0 / (h[6] * a + h[7] * b + h[8] + 1e-300)
        du = (h[0] * a + h[1] * b + h[2]) * w - m[2, k]
        dv = (h[3] * a + h[4] * b + h[5]) * w - m[3, k]
        r = du * du + dv * dv
        total += r if r < threshold_sq else threshold_sq
    return total


@kernel
def transfer_score(h, m, threshold_sq, bail_out):
    """MSAC score of a homography; stops once it exceeds bail_out."""
    n, total = m.shape[1], 0.0
    for start in range(0, n, BLOCK):
        total += transfer_block(h, m, start, min(start + BLOCK, n), threshold_sq)
        if total > bail_out:
            return total
    return total


@kernel
def transfer_all(h, m, out):
    """Squared transfer error of every match."""
    for k in range(m.shape[1]):
        a, b = m[0, k], m[1, k]
        w = 1.0 / (h[6] * a + h[7] * b + h[8] + 1e-300)
        du = (h[0] * a + h[1] * b + h[2]) * w - m[2, k]
        dv = (h[3] * a + h[4] * b + h[5]) * w - m[3, k]
        out[k] = du * du + dv * dv


@kernel(allocates=True)
def transfer_normal_equations(h, m, threshold_sq, a9, b9):
    """Gauss-Newton terms in the nine entries of H (one too many: the damping holds the scale); the score."""
    a9[:, :] = 0.0
    b9[:] = 0.0
    gu, gv = np.zeros(9), np.zeros(9)
    total = 0.0
    for k in range(m.shape[1]):
        a, b = m[0, k], m[1, k]
        w = 1.0 / (h[6] * a + h[7] * b + h[8] + 1e-300)
        u, v = (h[0] * a + h[1] * b + h[2]) * w, (h[3] * a + h[4] * b + h[5]) * w
        du, dv = u - m[2, k], v - m[3, k]
        r = du * du + dv * dv
        if not r < threshold_sq:
            total += threshold_sq
            continue
        total += r
        gu[0], gu[1], gu[2] = a * w, b * w, w
        gu[6], gu[7], gu[8] = -u * a * w, -u * b * w, -u * w
        gv[3], gv[4], gv[5] = a * w, b * w, w
        gv[6], gv[7], gv[8] = -v * a * w, -v * b * w, -v * w
        for i in range(9):
            b9[i] += gu[i] * du + gv[i] * dv
            for j in range(i + 1):
                a9[i, j] += gu[i] * gu[j] + gv[i] * gv[j]
    for i in range(9):
        for j in range(i):
            a9[j, i] = a9[i, j]
    return total


@kernel
def reprojection_all(motion, model, params, points, pixels, out):
    """Squared reprojection error of every point (3, n) against pixels (2, n); infinite where not visible."""
    for k in range(points.shape[1]):
        x, y, z = points[0, k], points[1, k], points[2, k]
        u, v = project_one(
            model,
            params,
            motion[0] * x + motion[1] * y + motion[2] * z + motion[9],
            motion[3] * x + motion[4] * y + motion[5] * z + motion[10],
            motion[6] * x + motion[7] * y + motion[8] * z + motion[11],
        )
        r = (u - pixels[0, k]) ** 2 + (v - pixels[1, k]) ** 2
        out[k] = r if r >= 0.0 else math.inf


@kernel
def reprojection_score(motion, model, params, points, pixels, threshold_sq, bail_out):
    """MSAC score of a pose; stops once it exceeds bail_out."""
    total = 0.0
    for k in range(points.shape[1]):
        x, y, z = points[0, k], points[1, k], points[2, k]
        u, v = project_one(
            model,
            params,
            motion[0] * x + motion[1] * y + motion[2] * z + motion[9],
            motion[3] * x + motion[4] * y + motion[5] * z + motion[10],
            motion[6] * x + motion[7] * y + motion[8] * z + motion[11],
        )
        r = (u - pixels[0, k]) ** 2 + (v - pixels[1, k]) ** 2
        total += r if r < threshold_sq else threshold_sq
        if total > bail_out:
            return total
    return total


@kernel(allocates=True)
def reprojection_normal_equations(motion, model, params, points, pixels, threshold_sq, a6, b6):
    """Gauss-Newton terms of exp(xi) @ cam_from_world over the points within the threshold; returns the score."""
    a6[:, :] = 0.0
    b6[:] = 0.0
    jac, jac_params, g = np.empty((2, 3)), np.empty((2, 8)), np.empty((2, 6))
    total = 0.0
    for k in range(points.shape[1]):
        px, py, pz = points[0, k], points[1, k], points[2, k]
        x = motion[0] * px + motion[1] * py + motion[2] * pz + motion[9]
        y = motion[3] * px + motion[4] * py + motion[5] * pz + motion[10]
        z = motion[6] * px + motion[7] * py + motion[8] * pz + motion[11]
        u, v = project_with_jacobian_one(model, params, x, y, z, jac, jac_params)
        du, dv = u - pixels[0, k], v - pixels[1, k]
        r = du * du + dv * dv
        if not r < threshold_sq:
            total += threshold_sq
            continue
        total += r
        for c in range(2):
            g[c, 0], g[c, 1], g[c, 2] = jac[c, 0], jac[c, 1], jac[c, 2]
            g[c, 3] = jac[c, 2] * y - jac[c, 1] * z
            g[c, 4] = jac[c, 0] * z - jac[c, 2] * x
            g[c, 5] = jac[c, 1] * x - jac[c, 0] * y
        for i in range(6):
            b6[i] += g[0, i] * du + g[1, i] * dv
            for j in range(i + 1):
                a6[i, j] += g[0, i] * g[0, j] + g[1, i] * g[1, j]
    for i in range(6):
        for j in range(i):
            a6[j, i] = a6[i, j]
    return total
