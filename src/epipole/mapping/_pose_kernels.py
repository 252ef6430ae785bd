"""Motion-only bundle adjustment: the pose of a camera, or of a rig of cameras, with the least robust error to known points."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import NUM_PARAMS, project_with_jacobian_one
from epipole.solvers._linear_kernels import clear, clear_rows, copy_numbers, solve_spd

LEAST_STEP_SQ = 1e-20
"""Squared length of the tangent step at which the iteration stops."""
STRONGEST = 1e9


@kernel
def _move(motion, xi, out):
    """Out = exp(xi) @ motion for the twist xi = (translation, rotation); Rodrigues."""
    x, y, z = xi[3], xi[4], xi[5]
    angle_sq = x * x + y * y + z * z
    angle = math.sqrt(angle_sq)
    first = 1.0 - angle_sq / 6.0 if angle < 1e-4 else math.sin(angle) / angle
    second = 0.5 - angle_sq / 24.0 if angle < 1e-4 else (1.0 - math.cos(angle)) / angle_sq
    for column in range(4):
        # Columns 0 to 2 are those of R, column 3 is t, which exp(xi) also shifts.
        if column < 3:
            a, b, c = motion[column], motion[3 + column], motion[6 + column]
        else:
            a, b, c = motion[9], motion[10], motion[11]
        u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
        p = a + first * u + second * (y * w - z * v)
        q = b + first * v + second * (z * u - x * w)
        r = c + first * w + second * (x * v - y * u)
        if column < 3:
            out[column], out[3 + column], out[6 + column] = p, q, r
        else:
            out[9], out[10], out[11] = p, q, r
    third = 1.0 / 6.0 - angle_sq / 120.0 if angle < 1e-3 else (1.0 - first) / angle_sq
    a, b, c = xi[0], xi[1], xi[2]
    u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
    out[9] += a + second * u + third * (y * w - z * v)
    out[10] += b + second * v + third * (z * u - x * w)
    out[11] += c + second * w + third * (x * v - y * u)


@kernel(fuse=True)
def _add_term(residual, row, weight, normal, gradient):
    """Add one scalar residual with its Jacobian row."""
    for i in range(6):
        gradient[i] += weight * row[i] * residual
        for j in range(i + 1):
            normal[i, j] += weight * row[i] * row[j]


@kernel(fuse=True)
def _twist_row(mounting, a, b, c, body, row):
    """Derivative of g . (R p + t) by xi, for p moved by exp(xi): R^T g and p x R^T g."""
    x, y, z = body
    d = mounting[0] * a + mounting[3] * b + mounting[6] * c
    e = mounting[1] * a + mounting[4] * b + mounting[7] * c
    f = mounting[2] * a + mounting[5] * b + mounting[8] * c
    row[0], row[1], row[2] = d, e, f
    row[3], row[4], row[5] = y * f - z * e, z * d - x * f, x * e - y * d


@kernel(fuse=True)
def _moved(motion, point):
    """R p + t of a motion (R row by row, then t)."""
    a, b, c = point
    return (
        motion[0] * a + motion[1] * b + motion[2] * c + motion[9],
        motion[3] * a + motion[4] * b + motion[5] * c + motion[10],
        motion[6] * a + motion[7] * b + motion[8] * c + motion[11],
    )


@kernel
def _linearize(view, motion, scale_sq, normal, gradient, error_sq, work):
    """Cost of a pose, its normal equations, and the squared error of every point, in units of sigma^2.

    Cauchy loss of the pixel error, and of the error of the disparity f B / Z if one was measured. A camera of a rig sees the point
    `mounting` * `motion` * X; the mounting of a single camera is the identity.
    """
    jac_point, jac_params, row = work
    clear_rows(normal)
    clear(gradient)
    cost = 0.0
    for k in range(len(view.points)):
        one = view.camera[k]
        mounting = view.mountings[one]
        body = _moved(motion, (view.points[k, 0], view.points[k, 1], view.points[k, 2]))
        x, y, z = _moved(mounting, body)
        u, v = project_with_jacobian_one(view.models[one], view.params[one], x, y, z, jac_point, jac_params)
        u, v = u - view.pixels[k, 0], v - view.pixels[k, 1]
        inverse_sq = 1.0 / (view.sigma_px[k] * view.sigma_px[k])
        s = (u * u + v * v) * inverse_sq
        if not s < STRONGEST:  # behind the camera, or outside its field of view
            error_sq[k] = math.inf
            cost += scale_sq * math.log1p(STRONGEST / scale_sq)
            continue
        error_sq[k] = s
        cost += scale_sq * math.log1p(s / scale_sq)
        weight = inverse_sq / (1.0 + s / scale_sq)
        _twist_row(mounting, jac_point[0, 0], jac_point[0, 1], jac_point[0, 2], body, row)
        _add_term(u, row, weight, normal, gradient)
        _twist_row(mounting, jac_point[1, 0], jac_point[1, 1], jac_point[1, 2], body, row)
        _add_term(v, row, weight, normal, gradient)
        d = view.disparity_px[k]
        if d == d:
            e = view.focal_baseline / z - d
            inverse_sq = 1.0 / (view.disparity_sigma_px * view.disparity_sigma_px)
            s = e * e * inverse_sq
            cost += scale_sq * math.log1p(s / scale_sq)
            weight = inverse_sq / (1.0 + s / scale_sq)
            _twist_row(mounting, 0.0, 0.0, -view.focal_baseline / (z * z), body, row)
            _add_term(e, row, weight, normal, gradient)
    for i in range(6):
        for j in range(i):
            normal[j, i] = normal[i, j]
    return cost


@kernel
def _sum_scores(view, motion, scale_sq, scores, own, work):
    """Scores = sum of g g^T over the points, where g (`own`) is a point's part of the gradient."""
    jac_point, jac_params, row = work
    clear_rows(scores)
    for k in range(len(view.points)):
        one = view.camera[k]
        mounting = view.mountings[one]
        body = _moved(motion, (view.points[k, 0], view.points[k, 1], view.points[k, 2]))
        x, y, z = _moved(mounting, body)
        u, v = project_with_jacobian_one(view.models[one], view.params[one], x, y, z, jac_point, jac_params)
        u, v = u - view.pixels[k, 0], v - view.pixels[k, 1]
        inverse_sq = 1.0 / (view.sigma_px[k] * view.sigma_px[k])
        s = (u * u + v * v) * inverse_sq
        if not s < STRONGEST:
            continue
        weight = inverse_sq / (1.0 + s / scale_sq)
        gx = jac_point[0, 0] * u + jac_point[1, 0] * v
        gy = jac_point[0, 1] * u + jac_point[1, 1] * v
        gz = jac_point[0, 2] * u + jac_point[1, 2] * v
        _twist_row(mounting, weight * gx, weight * gy, weight * gz, body, own)
        d = view.disparity_px[k]
        if d == d:
            e = view.focal_baseline / z - d
            inverse_sq = 1.0 / (view.disparity_sigma_px * view.disparity_sigma_px)
            weight = inverse_sq / (1.0 + e * e * inverse_sq / scale_sq)
            _twist_row(mounting, 0.0, 0.0, -weight * e * view.focal_baseline / (z * z), body, row)
            for i in range(6):
                own[i] += row[i]
        for i in range(6):
            for j in range(6):
                scores[i, j] += own[i] * own[j]


@kernel(allocates=True)
def refine_pose(view, scale_sq, max_steps, motion, information, scores, error_sq):
    """Damped Gauss-Newton; `motion` is the start and receives the result. Returns cost and number of steps.

    `information` receives the normal matrix at the result, the inverse covariance if the sigmas are right; `scores`
    receives the sum of g g^T over the points' gradients.
    """
    work = np.empty((2, 3)), np.empty((2, NUM_PARAMS)), np.empty(6)
    normal, gradient = np.empty((6, 6)), np.empty(6)
    damped, step, moved = np.empty((6, 6)), np.empty(6), np.empty(12)
    trial, trial_gradient, trial_error = np.empty((6, 6)), np.empty(6), np.empty(len(error_sq))
    cost = _linearize(view, motion, scale_sq, normal, gradient, error_sq, work)
    damping, steps = 1e-6, 0
    while steps < max_steps:
        steps += 1
        for i in range(6):
            for j in range(6):
                damped[i, j] = normal[i, j]
            damped[i, i] += damping * normal[i, i] + 1e-12
            step[i] = -gradient[i]
        if not solve_spd(damped, step, 6):
            break
        _move(motion, step, moved)
        after = _linearize(view, moved, scale_sq, trial, trial_gradient, trial_error, work)
        if after <= cost:
            copy_numbers(moved, motion)
            copy_numbers(trial_gradient, gradient)
            copy_numbers(trial_error, error_sq)
            for i in range(6):
                copy_numbers(trial[i], normal[i])
            length = 0.0
            for i in range(6):
                length += step[i] * step[i]
            fall = cost - after
            cost, damping = after, 0.1 * damping
            if length < LEAST_STEP_SQ or fall <= 1e-9 * cost:
                break
        else:
            damping *= 100.0
            if damping > 1e6:
                break
    for i in range(6):
        copy_numbers(normal[i], information[i])
    _sum_scores(view, motion, scale_sq, scores, step, work)
    return cost, steps
