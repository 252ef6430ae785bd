"""Bundle adjustment kernels: linearize, eliminate the points, sum the reduced system, substitute back.

Observation k of point X in image i, taken by sensor s of frame f with camera c:
    x_cam = cam_from_rig_s (rig_from_world_f X),   r_k = (project(c, x_cam) - pixel_k) / sigma_X,
is linearized under exp(xi) @ rig_from_world with xi = (translation, rotation), so that
    d x_rig / d xi = [I, -[x_rig]x],   d x_cam / d X = R_cam_from_world,
and likewise for cam_from_rig. Unknowns other than points are grouped into nodes: a frame (with its camera if no other
frame uses it), a shared camera, a sensor. With V = J_p^T J_p + damping = L L^T and W_a = J_a^T J_p for the nodes a that
observe a point, its elimination (the Schur complement; Triggs et al. 2000, section 6.1) takes the square root form

    Z_a = W_a L^-T,   h = L^-1 g_p,   S_ab -= Z_a Z_b^T,   rhs_a -= Z_a h,   step_p = -L^-T (h + sum Z_a^T step_a).

Only one Z per pair of a point and a node (an entry) is stored. Rows of S are summed node by node, each by one thread,
so the result does not depend on the number of threads. Arrays are padded to `lanes` columns, a tuple whose length the
compiler knows, so that loops over it vectorize. `wide` is the same for all columns of an observation: frame, camera,
sensor.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole._simd_kernels import (
    add_rows,
    add_two_rows,
    scale_row,
    set_rows,
    set_two_rows,
)
from epipole.cameras._camera_kernels import NUM_PARAMS, project_one, project_with_jacobian_one
from epipole.optim._bundle_arrays import ELIMINATED, KEPT, Scratch, rows_of_zeros
from epipole.optim._loss_kernels import allow_for_curvature, robust_loss


def make_scratch(wide: int) -> Scratch:
    """Working arrays of one thread, allocated outside the kernels to avoid reference counting inside."""
    return Scratch(
        np.empty((2, 3)),
        np.empty((2, NUM_PARAMS)),
        rows_of_zeros((2, wide)),
        np.empty((2, 3)),
        np.empty(6),
        rows_of_zeros((wide,)),
    )


@kernel(fuse=True)
def _residual(obs, k, scene, x, y, z):
    """Residual (ru, rv) of observation k of the point (x, y, z) in world coordinates."""
    i = obs.image[k]
    r = scene.cam_from_world[i]
    u, v = project_one(
        np.int64(scene.model[i]),
        scene.params[i],
        r[0] * x + r[1] * y + r[2] * z + r[9],
        r[3] * x + r[4] * y + r[5] * z + r[10],
        r[6] * x + r[7] * y + r[8] * z + r[11],
    )
    return u - obs.pixels[k, 0], v - obs.pixels[k, 1]


@kernel
def find_visible(obs, start, stop, scene):
    """Fill `used`: whether each observation of points start..stop has a finite residual."""
    points = scene.points
    for j in range(start, stop):
        for k in range(obs.offsets[j], obs.offsets[j + 1]):
            ru, rv = _residual(obs, k, scene, points[j, 0], points[j, 1], points[j, 2])
            obs.used[k] = ru * ru + rv * rv < math.inf


@kernel(fuse=True)
def _point_cost(obs, j, scene, x, y, z, loss, scale_sq):
    """Sum of rho over the observations of point j if it were at (x, y, z); infinite if it is behind a camera."""
    total, weight = 0.0, obs.inverse_sigma[j] * obs.inverse_sigma[j]
    for k in range(obs.offsets[j], obs.offsets[j + 1]):
        if obs.used[k]:
            ru, rv = _residual(obs, k, scene, x, y, z)
            rho, _ = robust_loss(loss, weight * (ru * ru + rv * rv), scale_sq)
            total += rho
    return total if total < math.inf else math.inf


@kernel
def total_cost(obs, start, stop, scene, loss, scale_sq):
    """Half the sum of rho(|r|^2) over points start..stop; infinite if a point is behind a camera."""
    total, points = 0.0, scene.points
    for j in range(start, stop):
        total += _point_cost(obs, j, scene, points[j, 0], points[j, 1], points[j, 2], loss, scale_sq)
    return 0.5 * total


@kernel
def damp_points(obs, start, stop, scene, role, loss, scale_sq, before, scratch):
    """Refine points start..stop with the moved cameras fixed, if that lowers the cost; returns half the sum of rho.

    This is one Gauss-Newton step of each point alone (the inner iteration of Ruhe and Wedin, SIAM Review 1980). A joint
    step is straight, but bending a long model moves points along arcs: they then disagree with the cameras by the square
    of the angle, and without the refinement the step would be rejected. A point that its step moved behind a camera
    restarts from `before`, so that single points do not block the adjustment.
    """
    total, points = 0.0, scene.points
    for j in range(start, stop):
        cost, x, y, z = _newton_point(obs, j, scene, loss, scale_sq, scratch)
        if cost == math.inf:
            for c in range(3):
                points[j, c] = before[j, c]
            cost, x, y, z = _newton_point(obs, j, scene, loss, scale_sq, scratch)
        if role[j] == ELIMINATED and cost < math.inf:
            moved_cost = _point_cost(obs, j, scene, x, y, z, loss, scale_sq)
            if moved_cost < cost:
                points[j, 0], points[j, 1], points[j, 2] = x, y, z
                cost = moved_cost
        total += cost
    return 0.5 * total


@kernel(fuse=True)
def _newton_point(obs, j, scene, loss, scale_sq, scratch):
    """Cost of point j (infinite if behind a camera), and its position after a Gauss-Newton step with fixed cameras."""
    by_cam, by_params, factor = scratch.by_point_in_cam, scratch.by_params, scratch.factor
    x, y, z = scene.points[j, 0], scene.points[j, 1], scene.points[j, 2]
    weight = obs.inverse_sigma[j] * obs.inverse_sigma[j]
    cost = v0 = v1 = v2 = v3 = v4 = v5 = g0 = g1 = g2 = 0.0
    for k in range(obs.offsets[j], obs.offsets[j + 1]):
        if not obs.used[k]:
            continue
        i = obs.image[k]
        r = scene.cam_from_world[i]
        u, v = project_with_jacobian_one(
            np.int64(scene.model[i]),
            scene.params[i],
            r[0] * x + r[1] * y + r[2] * z + r[9],
            r[3] * x + r[4] * y + r[5] * z + r[10],
            r[6] * x + r[7] * y + r[8] * z + r[11],
            by_cam,
            by_params,
        )
        ru, rv = u - obs.pixels[k, 0], v - obs.pixels[k, 1]
        rho, w = robust_loss(loss, weight * (ru * ru + rv * rv), scale_sq)
        cost += rho
        w *= weight
        a0 = by_cam[0, 0] * r[0] + by_cam[0, 1] * r[3] + by_cam[0, 2] * r[6]
        a1 = by_cam[0, 0] * r[1] + by_cam[0, 1] * r[4] + by_cam[0, 2] * r[7]
        a2 = by_cam[0, 0] * r[2] + by_cam[0, 1] * r[5] + by_cam[0, 2] * r[8]
        b0 = by_cam[1, 0] * r[0] + by_cam[1, 1] * r[3] + by_cam[1, 2] * r[6]
        b1 = by_cam[1, 0] * r[1] + by_cam[1, 1] * r[4] + by_cam[1, 2] * r[7]
        b2 = by_cam[1, 0] * r[2] + by_cam[1, 1] * r[5] + by_cam[1, 2] * r[8]
        g0, g1, g2 = g0 + w * (a0 * ru + b0 * rv), g1 + w * (a1 * ru + b1 * rv), g2 + w * (a2 * ru + b2 * rv)
        v0 += w * (a0 * a0 + b0 * b0)
        v1 += w * (a1 * a0 + b1 * b0)
        v2 += w * (a2 * a0 + b2 * b0)
        v3 += w * (a1 * a1 + b1 * b1)
        v4 += w * (a2 * a1 + b2 * b1)
        v5 += w * (a2 * a2 + b2 * b2)
    _factor_point(v0, v1, v2, v3, v4, v5, 1e-9, factor)
    h0 = factor[0] * g0
    h1 = factor[2] * (g1 - factor[1] * h0)
    h2 = factor[5] * (g2 - factor[3] * h0 - factor[4] * h1)
    d2 = -factor[5] * h2
    d1 = -factor[2] * (h1 + factor[4] * d2)
    d0 = -factor[0] * (h0 + factor[1] * d1 + factor[3] * d2)
    return cost if cost < math.inf else math.inf, x + d0, y + d1, z + d2


@kernel(fuse=True)
def _jacobians(obs, k, x, y, z, scene, unknowns, scratch):
    """Residual of observation k of the point (x, y, z); writes derivatives to j (2, wide) and j_point (2, 3)."""
    by_cam, j, j_point = scratch.by_point_in_cam, scratch.j, scratch.j_point
    i = obs.image[k]
    r, q = scene.cam_from_world[i], scene.cam_from_rig[i]
    a = r[0] * x + r[1] * y + r[2] * z + r[9]
    b = r[3] * x + r[4] * y + r[5] * z + r[10]
    d = r[6] * x + r[7] * y + r[8] * z + r[11]
    u, v = project_with_jacobian_one(
        np.int64(scene.model[i]), scene.params[i], a, b, d, by_cam, scratch.by_params
    )
    free, count = unknowns.frame_free[i], unknowns.num_free[i]
    for row in range(2):
        gx, gy, gz = by_cam[row, 0], by_cam[row, 1], by_cam[row, 2]
        j_point[row, 0] = gx * r[0] + gy * r[3] + gz * r[6]
        j_point[row, 1] = gx * r[1] + gy * r[4] + gz * r[7]
        j_point[row, 2] = gx * r[2] + gy * r[5] + gz * r[8]
        for p in range(count):
            j[row, 6 + p] = scratch.by_params[row, unknowns.free_params[i, p]]
        e, f, g = a, b, d
        if unknowns.has_rig[i]:
            if unknowns.nodes[i, 2] >= 0:
                own = unknowns.sensor_free[i]
                at = 6 + count
                j[row, at], j[row, at + 1], j[row, at + 2] = gx * own[0], gy * own[1], gz * own[2]
                j[row, at + 3] = (gz * b - gy * d) * own[3]
                j[row, at + 4] = (gx * d - gz * a) * own[4]
                j[row, at + 5] = (gy * a - gx * b) * own[5]
            e, f, g = a - q[9], b - q[10], d - q[11]  # x_rig and d pixel / d x_rig
            e, f, g = (
                q[0] * e + q[3] * f + q[6] * g,
                q[1] * e + q[4] * f + q[7] * g,
                q[2] * e + q[5] * f + q[8] * g,
            )
            gx, gy, gz = (
                gx * q[0] + gy * q[3] + gz * q[6],
                gx * q[1] + gy * q[4] + gz * q[7],
                gx * q[2] + gy * q[5] + gz * q[8],
            )
        j[row, 0], j[row, 1], j[row, 2] = gx * free[0], gy * free[1], gz * free[2]
        j[row, 3] = (gz * f - gy * g) * free[3]
        j[row, 4] = (gx * g - gz * e) * free[4]
        j[row, 5] = (gy * e - gx * f) * free[5]
    return u - obs.pixels[k, 0], v - obs.pixels[k, 1]


@kernel(fuse=True)
def _scale_rows(j, j_point, factor, wide):
    """Multiply the derivatives of an observation."""
    for row in range(2):
        for p in range(len(wide)):
            j[row, p] *= factor
        for c in range(3):
            j_point[row, c] *= factor


@kernel(fuse=True)
def _add_to_image(normal, gradient, j, weight, ru, rv, wide):
    """Normal += weight J^T J, gradient += weight J^T r."""
    add_two_rows(gradient, weight * ru, j[0], weight * rv, j[1], wide)
    for p in range(len(wide)):
        add_two_rows(normal[p], weight * j[0, p], j[0], weight * j[1, p], j[1], wide)


@kernel(fuse=True)
def _add_to_entries(k, first, entries, unknowns, i, z, j, j_point, weight, lanes):
    """W += weight J_a^T J_p in the entries that observation k touches."""
    slot = entries.slot[k]
    at = 6 + unknowns.num_free[i]
    for c in range(3):
        a, b = weight * j_point[0, c], weight * j_point[1, c]
        if slot[0] >= 0:  # columns beyond the node's width are zeroed later
            add_two_rows(z[first + slot[0], c], a, j[0], b, j[1], lanes)
        if slot[1] >= 0:
            w = z[first + slot[1], c]
            for q in range(unknowns.num_free[i]):
                w[q] += a * j[0, 6 + q] + b * j[1, 6 + q]
        if slot[2] >= 0:
            w = z[first + slot[2], c]
            for q in range(6):
                w[q] += a * j[0, at + q] + b * j[1, at + q]


@kernel(fuse=True)
def _factor_point(v0, v1, v2, v3, v4, v5, damping, factor):
    """L of the damped [[v0, ., .], [v1, v3, .], [v2, v4, v5]]; zeros if it is singular, so that the point stays fixed."""
    grown = 1.0 + damping
    l00 = math.sqrt(v0 * grown)
    i0 = 1.0 / l00
    l10, l20 = v1 * i0, v2 * i0
    d1 = v3 * grown - l10 * l10
    i1 = 1.0 / math.sqrt(d1) if d1 > 0.0 else 0.0
    l21 = (v4 - l20 * l10) * i1
    d2 = v5 * grown - l20 * l20 - l21 * l21
    i2 = 1.0 / math.sqrt(d2) if d2 > 0.0 else 0.0
    fine = v0 > 0.0 and i1 > 0.0 and i2 > 0.0 and i0 * i1 * i2 < math.inf
    factor[0] = i0 if fine else 0.0
    factor[1] = l10 if fine else 0.0
    factor[2] = i1 if fine else 0.0
    factor[3] = l20 if fine else 0.0
    factor[4] = l21 if fine else 0.0
    factor[5] = i2 if fine else 0.0


@kernel(fuse=True)
def _eliminate_point(j, entries, kept, g0, g1, g2, reduced, lanes):
    """W -> Z in the entries of point j, h, and reduced += Z h."""
    f, h = kept.factor[j], kept.h[j]
    h[0] = f[0] * g0
    h[1] = f[2] * (g1 - f[1] * h[0])
    h[2] = f[5] * (g2 - f[3] * h[0] - f[4] * h[1])
    for e in range(entries.start[j], entries.start[j + 1]):
        node = entries.node[e]
        z0, z1, z2 = kept.z[e, 0], kept.z[e, 1], kept.z[e, 2]
        for q in range(entries.width[node], len(lanes)):
            z0[q] = z1[q] = z2[q] = 0.0
        scale_row(z0, f[0], z0, lanes)
        set_two_rows(z1, f[2], z1, -f[2] * f[1], z0, lanes)
        set_rows(z2, f[5], z2, -f[5] * f[3], z0, -f[5] * f[4], z1, lanes)
        add_rows(reduced[node], h[0], z0, h[1], z1, h[2], z2, lanes)


@kernel
def linearize(
    obs, start, stop, scene, unknowns, entries, loss, scale_sq, damping, kept, sums, lanes, wide, scratch
):
    """Linearize points start..stop and eliminate them.

    `sums` are accumulated: the images' normal matrices (images, wide, wide) and gradients (images, wide), and sum Z h
    (nodes, lanes). For KEPT points, z holds W, factor V and h g_p. The damping is Marquardt's, a fraction of V's diagonal.
    """
    normal, gradient, reduced = sums
    jac, jp, points = scratch.j, scratch.j_point, scene.points
    for j in range(start, stop):
        first, x, y, z = entries.start[j], points[j, 0], points[j, 1], points[j, 2]
        for e in range(first, entries.start[j + 1]):
            for c in range(3):
                scale_row(kept.z[e, c], 0.0, scratch.zeros, lanes)
        v0 = v1 = v2 = v3 = v4 = v5 = g0 = g1 = g2 = 0.0
        for k in range(obs.offsets[j], obs.offsets[j + 1]):
            if not obs.used[k]:
                continue
            i = obs.image[k]
            for q in range(6, len(wide)):
                jac[0, q] = jac[1, q] = 0.0
            ru, rv = _jacobians(obs, k, x, y, z, scene, unknowns, scratch)
            if obs.inverse_sigma[j] != 1.0:
                ru, rv = ru * obs.inverse_sigma[j], rv * obs.inverse_sigma[j]
                _scale_rows(jac, jp, obs.inverse_sigma[j], wide)
            _, w = robust_loss(loss, ru * ru + rv * rv, scale_sq)
            if w == 0.0:
                continue
            ru, rv = allow_for_curvature(loss, scale_sq, ru, rv, jac, jp)
            _add_to_image(normal[i], gradient[i], jac, w, ru, rv, wide)
            _add_to_entries(k, first, entries, unknowns, i, kept.z, jac, jp, w, lanes)
            a0, a1, a2, b0, b1, b2 = jp[0, 0], jp[0, 1], jp[0, 2], jp[1, 0], jp[1, 1], jp[1, 2]
            g0 += w * (a0 * ru + b0 * rv)
            g1 += w * (a1 * ru + b1 * rv)
            g2 += w * (a2 * ru + b2 * rv)
            v0 += w * (a0 * a0 + b0 * b0)
            v1 += w * (a1 * a0 + b1 * b0)
            v2 += w * (a2 * a0 + b2 * b0)
            v3 += w * (a1 * a1 + b1 * b1)
            v4 += w * (a2 * a1 + b2 * b1)
            v5 += w * (a2 * a2 + b2 * b2)
        factor = kept.factor[j]
        if unknowns.role[j] == KEPT:
            factor[0], factor[1], factor[2], factor[3], factor[4], factor[5] = v0, v1, v2, v3, v4, v5
            kept.h[j, 0], kept.h[j, 1], kept.h[j, 2] = g0, g1, g2
            continue
        if unknowns.role[j] == ELIMINATED:
            _factor_point(v0, v1, v2, v3, v4, v5, damping, factor)
        else:
            for c in range(6):
                factor[c] = 0.0
        _eliminate_point(j, entries, kept, g0, g1, g2, reduced, lanes)
