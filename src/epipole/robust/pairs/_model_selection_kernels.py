"""Model selection for the matches of a pair: epipolar geometry, a plane, a rotation, or no motion.

Torr's geometric robust information criterion (PhilTrans A 1998, eq. 12), for n matches in r = 4 dimensions and a model of k
parameters whose matches lie on a manifold of d dimensions:

    GRIC = sum_i min(e_i^2 / sigma^2, 2 (r - d)) + n d log r + k log(r n);

the lowest wins. Epipolar geometry has d = 3 and k = 5 (calibrated) or 7, a homography d = 2 and k = 8, a rotation d = 2 and
and k = 3 (4 with the focal length), no motion d = 2 and k = 0.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import project_one, unproject_one
from epipole.robust._item_kernels import median, rotate_left
from epipole.robust.pairs._pair_kernels import LEAST_DEPTH
from epipole.solvers._linear_kernels import clear, clear_rows, solve_spd
from epipole.solvers._two_view_kernels import svd3

EPIPOLAR, PLANE, ROTATION, NO_MOTION, NONE = 0, 1, 2, 3, -1
"""The models, in the order of the costs; NONE if too few matches agree with any."""
ROTATING_FRACTION = 0.9
TRUSTED_FOCAL = 0.4  # largest correction of a trusted log focal length by a rotation
GUESSED_FOCAL = 1.2  # the same, for a guessed focal length
ROTATION_STEPS = 8
LEAST_NOISE_PX = 0.25  # lower bound of the pixel noise, whatever the residuals


class Selection(NamedTuple):
    """The best model of every pair."""

    model: np.ndarray
    """(pairs,), one of EPIPOLAR ... NONE."""
    cost: np.ndarray
    """(pairs, 4): GRIC of epipolar geometry, homography, rotation, no motion; lower is better."""
    noise_px: np.ndarray
    rotation: np.ndarray
    """(pairs, 9), the best pure rotation."""
    median_angle_rad: np.ndarray
    """Between the rays of inliers in front of both cameras; NaN without motion."""


@kernel
def _gric(total, count, dimension, parameters):
    """GRIC for `total`, its first term."""
    return total + count * dimension * math.log(4.0) + parameters * math.log(4.0 * count)


@kernel(fuse=True)
def _rotation_error_sq(pairs, p, k, r, ray):
    """Squared distance between the pixel of a rotated ray and its match in image 2."""
    camera = pairs.camera2[p]
    u, v = project_one(
        np.int64(pairs.models[camera]),
        pairs.params[camera],
        r[0] * ray[0] + r[1] * ray[1] + r[2] * ray[2],
        r[3] * ray[0] + r[4] * ray[1] + r[5] * ray[2],
        r[6] * ray[0] + r[7] * ray[1] + r[8] * ray[2],
    )
    error = (u - pairs.pixels[2, k]) ** 2 + (v - pairs.pixels[3, k]) ** 2
    return error if error >= 0.0 else math.inf


@kernel(allocates=True)
def _fit_rotation(pairs, p, chosen, rays1, rays2, scale_px, rotation):
    """The rotation from rays 1 to rays 2 (Kabsch 1976), iteratively reweighted with Cauchy weights."""
    m, u, s, v = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for i in range(9):
        rotation[i] = 1.0 if i % 4 == 0 else 0.0
    for iteration in range(8):
        clear_rows(m)
        for c in range(len(chosen)):
            weight = 1.0
            if iteration > 0:
                error = _rotation_error_sq(pairs, p, chosen[c], rotation, rays1[c])
                weight = 1.0 / (1.0 + error / scale_px**2)
            if weight > 0.0:
                for i in range(3):
                    for j in range(3):
                        m[i, j] += weight * rays2[c, i] * rays1[c, j]
        if not svd3(m, u, s, v):
            return
        for i in range(3):
            for j in range(3):
                rotation[3 * i + j] = u[i, 0] * v[j, 0] + u[i, 1] * v[j, 1] + u[i, 2] * v[j, 2]


@kernel(allocates=True)
def _fit_rotating_camera(rays1, rays2, focal_px, variance, rotation):
    """Refine a rotation together with a factor g of the focal lengths, on the planes z = 1; returns g and the fit.

    x2 = g h(R (x1 / g)), where h divides by the third coordinate; Gauss-Newton in (phi, log g) with Cauchy weights. The fit is
    the sum of squared transfer errors over two variances, each truncated at 4.
    """
    a, b, step = np.empty((4, 4)), np.empty(4), np.empty((2, 4))
    rotated, r, g = np.empty(9), rotation.copy(), 1.0
    for iteration in range(ROTATION_STEPS + 1):
        total = 0.0
        clear_rows(a)
        clear(b)
        for c in range(len(rays1)):
            if not (rays1[c, 2] > LEAST_DEPTH and rays2[c, 2] > LEAST_DEPTH):
                total += 4.0
                continue
            u, v = rays1[c, 0] / rays1[c, 2] / g, rays1[c, 1] / rays1[c, 2] / g
            x, y, z = r[0] * u + r[1] * v + r[2], r[3] * u + r[4] * v + r[5], r[6] * u + r[7] * v + r[8]
            if not z > LEAST_DEPTH:
                total += 4.0
                continue
            p, q = x / z, y / z
            eu, ev = g * p - rays2[c, 0] / rays2[c, 2], g * q - rays2[c, 1] / rays2[c, 2]
            error = 0.5 * focal_px * focal_px * (eu * eu + ev * ev) / variance
            total += min(error, 4.0)
            weight = 1.0 / (1.0 + error / 4.0)
            # dx = phi x x, and d(u, v) = -(u, v) dlog g.
            dx, dy, dz = -(r[0] * u + r[1] * v), -(r[3] * u + r[4] * v), -(r[6] * u + r[7] * v)
            step[0, 0], step[0, 1], step[0, 2] = -g * p * y / z, g * (z + p * x) / z, -g * y / z
            step[1, 0], step[1, 1], step[1, 2] = -g * (z + q * y) / z, g * q * x / z, g * x / z
            step[0, 3], step[1, 3] = g * p + g * (dx - p * dz) / z, g * q + g * (dy - q * dz) / z
            for i in range(4):
                b[i] -= weight * (step[0, i] * eu + step[1, i] * ev)
                for j in range(4):
                    a[i, j] += weight * (step[0, i] * step[0, j] + step[1, i] * step[1, j])
        if iteration == ROTATION_STEPS:
            break
        for i in range(4):
            a[i, i] += 1e-9 * a[i, i] + 1e-15
        if not solve_spd(a, b, 4):
            break
        rotate_left(b, r, rotated)
        for i in range(9):
            r[i] = rotated[i]
        g *= math.exp(min(max(b[3], -0.5), 0.5))
    return g, total


@kernel(allocates=True)
def _parallax(motion, rays1, rays2):
    """Median angle between matched rays that intersect in front of both cameras."""
    angles, count = np.empty(len(rays1)), 0
    for c in range(len(rays1)):
        a, b = rays1[c], rays2[c]
        x = motion[0] * a[0] + motion[1] * a[1] + motion[2] * a[2]
        y = motion[3] * a[0] + motion[4] * a[1] + motion[5] * a[2]
        z = motion[6] * a[0] + motion[7] * a[1] + motion[8] * a[2]
        dot = x * b[0] + y * b[1] + z * b[2]
        at = x * motion[9] + y * motion[10] + z * motion[11]
        bt = b[0] * motion[9] + b[1] * motion[10] + b[2] * motion[11]
        if dot * bt - at > 0.0 and bt - dot * at > 0.0:
            cx, cy, cz = y * b[2] - z * b[1], z * b[0] - x * b[2], x * b[1] - y * b[0]
            angles[count] = math.atan2(math.sqrt(cx * cx + cy * cy + cz * cz), dot)
            count += 1
    return median(angles, count) if count > 0 else math.nan


@kernel(allocates=True)
def select_models(pairs, calibrated, search, epipolar, planes, motions, selection):
    """Compare epipolar geometry, homography, rotation and no motion on the epipolar inliers.

    Distances are orthogonal ones in the four dimensions of a match, to first order: the Sampson distance for epipolar geometry,
    half the squared transfer error for the others, whose noise comes from both images. Each is truncated at 2 (4 - d)
    variances, where the noise is estimated from the epipolar residuals. Focal lengths are never known well enough for a
    rotation to fit within the noise, so it may correct them. With guessed focal lengths it also replaces the homography if it
    explains nearly all matches within the threshold.
    """
    for p in range(len(pairs.seed)):
        first, last = pairs.offsets[p], pairs.offsets[p + 1]
        chosen, count = np.empty(last - first, np.int64), 0
        for k in range(first, last):
            if epipolar.residuals_px[k] < search.max_error_px:
                chosen[count] = k
                count += 1
        selection.model[p] = NONE
        selection.noise_px[p] = selection.median_angle_rad[p] = math.nan
        selection.cost[p, :] = math.nan
        selection.rotation[p, :] = math.nan
        if not epipolar.best_score[p] < math.inf or count < search.min_inliers:
            continue
        chosen = chosen[:count]
        rays1, rays2, sizes = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
        for c in range(count):
            k, one, two = chosen[c], pairs.camera1[p], pairs.camera2[p]
            x, y, z = unproject_one(
                np.int64(pairs.models[one]), pairs.params[one], pairs.pixels[0, k], pairs.pixels[1, k]
            )
            rays1[c, 0], rays1[c, 1], rays1[c, 2] = x, y, z
            x, y, z = unproject_one(
                np.int64(pairs.models[two]), pairs.params[two], pairs.pixels[2, k], pairs.pixels[3, k]
            )
            rays2[c, 0], rays2[c, 1], rays2[c, 2] = x, y, z
            sizes[c] = epipolar.residuals_px[k] ** 2
        # The median of the square of a normal variable is 0.455 variances.
        variance = max(median(sizes, count) / 0.455, LEAST_NOISE_PX**2)
        rotation = selection.rotation[p]
        scale_px = 2.0 * math.sqrt(variance) if calibrated[p] else search.max_error_px
        _fit_rotation(pairs, p, chosen, rays1, rays2, scale_px, rotation)
        totals, rotating = np.zeros(4), 0
        for c in range(count):
            k = chosen[c]
            still = (pairs.pixels[2, k] - pairs.pixels[0, k]) ** 2 + (
                pairs.pixels[3, k] - pairs.pixels[1, k]
            ) ** 2
            plane = planes.residuals_px[k] ** 2
            rotated = _rotation_error_sq(pairs, p, k, rotation, rays1[c])
            rotating += 1 if rotated < search.max_error_px**2 else 0
            totals[0] += min(epipolar.residuals_px[k] ** 2 / variance, 2.0)
            totals[1] += min(0.5 * plane / variance, 4.0)
            totals[2] += min(0.5 * rotated / variance, 4.0)
            totals[3] += min(0.5 * still / variance, 4.0)
        cost = selection.cost[p]
        cost[0] = _gric(totals[0], count, 3.0, 5.0 if calibrated[p] else 7.0)
        cost[1] = _gric(totals[1], count, 2.0, 8.0)
        cost[2] = _gric(totals[2], count, 2.0, 3.0)
        focal_px = 0.5 * (pairs.focal_px[pairs.camera1[p]] + pairs.focal_px[pairs.camera2[p]])
        g, rotating_camera = _fit_rotating_camera(rays1, rays2, focal_px, variance, rotation)
        if abs(math.log(g)) < (TRUSTED_FOCAL if calibrated[p] else GUESSED_FOCAL):
            cost[2] = min(cost[2], _gric(rotating_camera, count, 2.0, 4.0))
        cost[3] = _gric(totals[3], count, 2.0, 0.0)
        best = 0
        for i in range(1, 4):
            if cost[i] < cost[best]:
                best = i
        # A rotation with a guessed focal length is never exact: it need only explain nearly all matches within the threshold.
        if best == PLANE and not calibrated[p] and rotating >= ROTATING_FRACTION * count:
            best = ROTATION
        selection.model[p] = best
        selection.noise_px[p] = math.sqrt(variance)
        if best < ROTATION and motions.best_score[p] < math.inf:
            selection.median_angle_rad[p] = _parallax(motions.raw[p], rays1, rays2)
