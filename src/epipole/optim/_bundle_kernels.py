"""Bundle adjustment's inner loops: linearise, eliminate the points, substitute back.

Observation k of point j by sensor s of frame f with camera c:
    x_cam = cam_from_rig_s (rig_from_world_f X_j),   r_k = project(c, x_cam) - pixel_k,
linearised under exp(xi) @ rig_from_world with xi = (translation, rotation), so that
    d x_rig / d xi = [I, -[x_rig]x],   d x_rig / d X = R_f.
Points are eliminated one by one (the Schur complement; Triggs et al. 2000, section 6.1): with V = J_p^T J_p,
W_b = J_b^T J_p for each block b (a frame or a camera) that sees the point,
    S -= W_a V^-1 W_b^T,   rhs -= W_a V^-1 g_p.
Observations are sorted by point. What back-substitution needs of a point, its blocks W and V^-1, is kept from
the elimination: some 200 bytes an observation, for half of a step's time.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import project_one, project_with_jacobian_one

TRIVIAL, HUBER, SOFT_L1, CAUCHY, TRUNCATED = 0, 1, 2, 3, 4
LEAST_CURVATURE = 0.7
BLOCK = 8  # columns kept per block: six of a frame or up to eight of a camera


class Scene(NamedTuple):
    """Where everything is; motions are rows of nine rotation and three translation entries."""

    frames: np.ndarray
    """rig_from_world, (frames, 12)."""
    sensors: np.ndarray
    """cam_from_rig, (sensors, 12)."""
    models: np.ndarray
    params: np.ndarray
    """Intrinsics, (cameras, 8)."""
    points: np.ndarray
    """In world coordinates, (points, 3)."""


class Unknowns(NamedTuple):
    """What may move, and in which column of the reduced system it stands."""

    point_free: np.ndarray
    frame_free: np.ndarray
    """(frames, 6) of 0 and 1."""
    frame_column: np.ndarray
    """The first column of each frame; -1 for one that stays."""
    camera_column: np.ndarray
    free_params: np.ndarray
    num_free: np.ndarray


class Scratch(NamedTuple):
    """Room for one observation's Jacobians and one point's matrices."""

    jac: np.ndarray
    j_frame: np.ndarray
    j_point: np.ndarray
    j_params: np.ndarray
    v: np.ndarray
    y: np.ndarray


class Eliminated(NamedTuple):
    """What is kept of the eliminated points. Point j owns the rows 2 offsets[j] to 2 offsets[j + 1] of its blocks."""

    w: np.ndarray
    """(2 observations, BLOCK, 3), blocks W."""
    column: np.ndarray
    """(2 observations,), the first column of each block."""
    size: np.ndarray
    """(2 observations,), how many columns it has."""
    count: np.ndarray
    """(points,), the number of blocks; -1 for a point that stays."""
    inverse: np.ndarray
    """(points, 3, 3), V^-1 with damping."""
    gradient: np.ndarray
    """(points, 3), g_p."""
    damp: np.ndarray
    """(points, 3), what damping added to the diagonal of V."""


@kernel
def robust_loss(kind, s, scale_sq):
    """(rho, rho') of the squared residual s; rho(s) = s for small s."""
    if kind == TRIVIAL:
        return s, 1.0
    if kind == HUBER:
        if s <= scale_sq:
            return s, 1.0
        root = math.sqrt(s * scale_sq)
        return 2.0 * root - scale_sq, scale_sq / root
    if kind == SOFT_L1:
        root = math.sqrt(1.0 + s / scale_sq)
        return 2.0 * scale_sq * (root - 1.0), 1.0 / root
    if kind == CAUCHY:
        return scale_sq * math.log1p(s / scale_sq), 1.0 / (1.0 + s / scale_sq)
    if s < scale_sq:
        return s, 1.0
    return scale_sq, 0.0


@kernel
def _allow_for_curvature(kind, scale_sq, ru, rv, work):
    """Triggs' second-order correction of a robust term (Triggs et al. 2000, section 4.3): J, r -> J', r'.

    Along r the loss curves by rho' + 2 s rho'' < rho' only. With k = 1 + 2 s rho'' / rho' and the unit vector d
    along r, J' = (I - (1 - sqrt(k)) d d^T) J and r' = r / sqrt(k) give that curvature and the same gradient.
    Weighting alone (k = 1) converges linearly and takes about a third more steps; smaller k than LEAST_CURVATURE
    overshoots where residuals are large (measured: it takes more steps again).
    """
    s = ru * ru + rv * rv
    if kind == HUBER:
        k = 1.0 if s <= scale_sq else 0.0
    elif kind == SOFT_L1:
        k = scale_sq / (scale_sq + s)
    elif kind == CAUCHY:
        k = (scale_sq - s) / (scale_sq + s)
    else:
        k = 1.0
    if k == 1.0 or s == 0.0:
        return ru, rv
    root, size = math.sqrt(max(k, LEAST_CURVATURE)), math.sqrt(s)
    du, dv = ru / size, rv / size
    for jacobian in work:
        for i in range(jacobian.shape[1]):
            along = (1.0 - root) * (du * jacobian[0, i] + dv * jacobian[1, i])
            jacobian[0, i] -= along * du
            jacobian[1, i] -= along * dv
    return ru / root, rv / root


@kernel
def _residual(obs, k, scene, x, y, z):
    """Residual (ru, rv) of observation k of the point (x, y, z) in world coordinates."""
    f, s, c = obs.frame[k], obs.sensor[k], obs.camera[k]
    r, q = scene.frames[f], scene.sensors[s]
    a = r[0] * x + r[1] * y + r[2] * z + r[9]
    b = r[3] * x + r[4] * y + r[5] * z + r[10]
    d = r[6] * x + r[7] * y + r[8] * z + r[11]
    u, v = project_one(
        np.int64(scene.models[c]),
        scene.params[c],
        q[0] * a + q[1] * b + q[2] * d + q[9],
        q[3] * a + q[4] * b + q[5] * d + q[10],
        q[6] * a + q[7] * b + q[8] * d + q[11],
    )
    return u - obs.pixels[k, 0], v - obs.pixels[k, 1]


@kernel
def total_cost(obs, start, stop, scene, loss, scale_sq):
    """Half the sum of rho(|r|^2) over the points start..stop; infinite when a point fell behind a camera."""
    total, points = 0.0, scene.points
    for j in range(start, stop):
        for k in range(obs.offsets[j], obs.offsets[j + 1]):
            ru, rv = _residual(obs, k, scene, points[j, 0], points[j, 1], points[j, 2])
            rho, _ = robust_loss(loss, ru * ru + rv * rv, scale_sq)
            total += rho
    return 0.5 * total if total < math.inf else math.inf


@kernel
def _jacobians(obs, k, j, scene, frame_free, scratch):
    """Residual of observation k of point j; its derivatives go to j_frame (2, 6), j_point (2, 3), j_params (2, 8)."""
    jac, j_frame, j_point = scratch.jac, scratch.j_frame, scratch.j_point
    f, s, c = obs.frame[k], obs.sensor[k], obs.camera[k]
    r, q = scene.frames[f], scene.sensors[s]
    x, y, z = scene.points[j, 0], scene.points[j, 1], scene.points[j, 2]
    a = r[0] * x + r[1] * y + r[2] * z + r[9]
    b = r[3] * x + r[4] * y + r[5] * z + r[10]
    d = r[6] * x + r[7] * y + r[8] * z + r[11]
    u, v = project_with_jacobian_one(
        np.int64(scene.models[c]),
        scene.params[c],
        q[0] * a + q[1] * b + q[2] * d + q[9],
        q[3] * a + q[4] * b + q[5] * d + q[10],
        q[6] * a + q[7] * b + q[8] * d + q[11],
        jac,
        scratch.j_params,
    )
    for i in range(2):
        # d pixel / d x_rig
        gx = jac[i, 0] * q[0] + jac[i, 1] * q[3] + jac[i, 2] * q[6]
        gy = jac[i, 0] * q[1] + jac[i, 1] * q[4] + jac[i, 2] * q[7]
        gz = jac[i, 0] * q[2] + jac[i, 1] * q[5] + jac[i, 2] * q[8]
        j_frame[i, 0], j_frame[i, 1], j_frame[i, 2] = gx, gy, gz
        j_frame[i, 3] = gz * b - gy * d
        j_frame[i, 4] = gx * d - gz * a
        j_frame[i, 5] = gy * a - gx * b
        j_point[i, 0] = gx * r[0] + gy * r[3] + gz * r[6]
        j_point[i, 1] = gx * r[1] + gy * r[4] + gz * r[7]
        j_point[i, 2] = gx * r[2] + gy * r[5] + gz * r[8]
        for p in range(6):
            j_frame[i, p] *= frame_free[f, p]
    return u - obs.pixels[k, 0], v - obs.pixels[k, 1]


@kernel
def _invert_spd3(v, out):
    """Inverse of a symmetric positive definite 3 x 3 matrix; False if it is not."""
    a, b, c, d, e, f = v[0, 0], v[1, 0], v[2, 0], v[1, 1], v[2, 1], v[2, 2]
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * p + b * q + c * r
    if not det > 1e-300:
        return False
    i = 1.0 / det
    out[0, 0], out[1, 1], out[2, 2] = p * i, (a * f - c * c) * i, (a * d - b * b) * i
    out[0, 1] = out[1, 0] = q * i
    out[0, 2] = out[2, 0] = r * i
    out[1, 2] = out[2, 1] = (b * c - a * e) * i
    return True


@kernel
def _block_of(columns, sizes, count, column, size):
    """The position of the block with this first column, appended if new."""
    for b in range(count):
        if columns[b] == column:
            return b
    columns[count], sizes[count] = column, size
    return count


@kernel
def _point_terms(obs, j, scene, unknowns, loss, scale_sq, scratch, w, columns, sizes, gp, s, g):
    """Accumulate V, g_p and the W blocks of point j; its blocks' own terms go straight into S (lower) and g.

    Returns the number of blocks and the cost.
    """
    j_frame, j_point, j_params, v = scratch.j_frame, scratch.j_point, scratch.j_params, scratch.v
    count, cost = 0, 0.0
    v[:, :] = 0.0
    gp[:] = 0.0
    for k in range(obs.offsets[j], obs.offsets[j + 1]):
        ru, rv = _jacobians(obs, k, j, scene, unknowns.frame_free, scratch)
        rho, weight = robust_loss(loss, ru * ru + rv * rv, scale_sq)
        cost += rho
        if weight == 0.0:
            continue
        ru, rv = _allow_for_curvature(loss, scale_sq, ru, rv, (j_frame, j_point, j_params))
        for a in range(3):
            j_point[0, a] *= unknowns.point_free[j]
            j_point[1, a] *= unknowns.point_free[j]
        for a in range(3):
            gp[a] += weight * (j_point[0, a] * ru + j_point[1, a] * rv)
            for b in range(a + 1):
                v[a, b] += weight * (j_point[0, a] * j_point[0, b] + j_point[1, a] * j_point[1, b])
        f, c = obs.frame[k], obs.camera[k]
        first_f, first_c, nc = unknowns.frame_column[f], unknowns.camera_column[c], unknowns.num_free[c]
        if nc > 0:
            for i in range(nc):  # gather the free parameters' columns to the front
                p = unknowns.free_params[c, i]
                j_params[0, i], j_params[1, i] = j_params[0, p], j_params[1, p]
            for a in range(nc):
                g[first_c + a] += weight * (j_params[0, a] * ru + j_params[1, a] * rv)
                for b in range(a + 1):
                    s[first_c + a, first_c + b] += weight * (
                        j_params[0, a] * j_params[0, b] + j_params[1, a] * j_params[1, b]
                    )
            block = _block_of(columns, sizes, count, first_c, nc)
            if block == count:
                count += 1
                w[block, :, :] = 0.0
            for a in range(nc):
                for b in range(3):
                    w[block, a, b] += weight * (
                        j_params[0, a] * j_point[0, b] + j_params[1, a] * j_point[1, b]
                    )
        if first_f >= 0:
            for a in range(6):
                g[first_f + a] += weight * (j_frame[0, a] * ru + j_frame[1, a] * rv)
                for b in range(a + 1):
                    s[first_f + a, first_f + b] += weight * (
                        j_frame[0, a] * j_frame[0, b] + j_frame[1, a] * j_frame[1, b]
                    )
            block = _block_of(columns, sizes, count, first_f, 6)
            if block == count:
                count += 1
                w[block, :, :] = 0.0
            for a in range(6):
                for b in range(3):
                    w[block, a, b] += weight * (j_frame[0, a] * j_point[0, b] + j_frame[1, a] * j_point[1, b])
            for a in range(nc):  # cameras' columns come after all frames': the lower triangle
                for b in range(6):
                    s[first_c + a, first_f + b] += weight * (
                        j_params[0, a] * j_frame[0, b] + j_params[1, a] * j_frame[1, b]
                    )
    return count, 0.5 * cost


@kernel(allocates=True)
def build_reduced_system(obs, start, stop, scene, unknowns, loss, scale_sq, damping, kept, s, g, rhs):
    """S (lower triangle), gradient g and the points' part of the right-hand side, over the points start..stop.

    The damping is Marquardt's, on the diagonal of V here and of S by the caller. Returns the cost.
    """
    scratch = Scratch(
        np.empty((2, 3)),
        np.empty((2, 6)),
        np.empty((2, 3)),
        np.empty((2, 8)),
        np.empty((3, 3)),
        np.empty((BLOCK, 3)),
    )
    return _eliminate(obs, start, stop, scene, unknowns, loss, scale_sq, damping, kept, s, g, rhs, scratch)


@kernel
def _eliminate(obs, start, stop, scene, unknowns, loss, scale_sq, damping, kept, s, g, rhs, scratch):
    """The loop of `build_reduced_system`, apart from it so that it counts no references."""
    v, y = scratch.v, scratch.y
    cost = 0.0
    for j in range(start, stop):
        own = slice(2 * obs.offsets[j], 2 * obs.offsets[j + 1])
        w, columns, sizes = kept.w[own], kept.column[own], kept.size[own]
        inverse, gp = kept.inverse[j], kept.gradient[j]
        count, this = _point_terms(
            obs, j, scene, unknowns, loss, scale_sq, scratch, w, columns, sizes, gp, s, g
        )
        cost += this
        kept.count[j] = -1
        if unknowns.point_free[j] == 0.0:
            continue
        for a in range(3):
            kept.damp[j, a] = damping * v[a, a]
            v[a, a] += kept.damp[j, a] + 1e-12
        if not _invert_spd3(v, inverse):
            continue
        kept.count[j] = count
        for a in range(count):
            ca = columns[a]
            for p in range(sizes[a]):
                w0, w1, w2 = w[a, p, 0], w[a, p, 1], w[a, p, 2]
                for c in range(3):
                    y[p, c] = w0 * inverse[0, c] + w1 * inverse[1, c] + w2 * inverse[2, c]
                rhs[ca + p] += y[p, 0] * gp[0] + y[p, 1] * gp[1] + y[p, 2] * gp[2]
            for b in range(count):
                cb = columns[b]
                if cb < ca and sizes[a] == 6 and sizes[b] == 6:
                    for p in range(6):  # between frames: of known length, so that the loops unroll
                        y0, y1, y2 = y[p, 0], y[p, 1], y[p, 2]
                        for q in range(6):
                            s[ca + p, cb + q] -= y0 * w[b, q, 0] + y1 * w[b, q, 1] + y2 * w[b, q, 2]
                elif cb < ca:
                    for p in range(sizes[a]):
                        y0, y1, y2 = y[p, 0], y[p, 1], y[p, 2]
                        for q in range(sizes[b]):
                            s[ca + p, cb + q] -= y0 * w[b, q, 0] + y1 * w[b, q, 1] + y2 * w[b, q, 2]
                elif cb == ca:
                    for p in range(sizes[a]):
                        for q in range(p + 1):
                            s[ca + p, cb + q] -= (
                                y[p, 0] * w[b, q, 0] + y[p, 1] * w[b, q, 1] + y[p, 2] * w[b, q, 2]
                            )
    return cost


@kernel
def substitute_back(offsets, start, stop, points, kept, step, moved):
    """Steps of the points start..stop for the step of frames and cameras; moved = points + steps.

    Returns the points' part of the decrease that the linear model predicts, step^T (damping D step - g) / 2.
    """
    predicted = 0.0
    for j in range(start, stop):
        for c in range(3):
            moved[j, c] = points[j, c]
        if kept.count[j] < 0:
            continue
        inverse, gp, damp = kept.inverse[j], kept.gradient[j], kept.damp[j]
        e0, e1, e2 = gp[0], gp[1], gp[2]
        for block in range(2 * offsets[j], 2 * offsets[j] + kept.count[j]):
            w, first = kept.w[block], kept.column[block]
            for a in range(kept.size[block]):
                e0 += w[a, 0] * step[first + a]
                e1 += w[a, 1] * step[first + a]
                e2 += w[a, 2] * step[first + a]
        for c in range(3):
            d = -(inverse[c, 0] * e0 + inverse[c, 1] * e1 + inverse[c, 2] * e2)
            moved[j, c] += d
            predicted += 0.5 * d * (damp[c] * d - gp[c])
    return predicted
