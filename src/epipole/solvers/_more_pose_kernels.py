"""Pose solvers beyond P3P: unknown focal length (P4Pf), camera rigs (gP3P), known vertical (uP2P, 3-point)."""

import math

import numpy as np

from epipole._jit import kernel
from epipole.solvers._alignment_kernels import align_three_points
from epipole.solvers._linear_kernels import clear, clear_rows, null_space, reduce_rows
from epipole.solvers._polynomial_kernels import real_roots, roots_workspace
from epipole.solvers._quadrics_kernels import intersect_quadrics, quadrics_workspace

FOCAL = 12  # index of the focal length in a model, after R and t


@kernel
def generalized_p3p(origins, rays, points, motions, w):
    """rig_from_world from three rays o_i + l_i d_i and points: o_i + l_i d_i = R X_i + t, l_i > 0.

    The three distances |X_i - X_j| are quadrics in the depths l (Nister and Stewenius, J. Math. Imaging Vis. 2007; solved by
    E3Q3); then the triangles are aligned. Assumes unit rays, non-collinear points, and no two orthogonal rays. Rays may share
    an origin. Writes up to eight motions (k, 13); returns k.
    """
    quadrics, solutions, seen, a, b, solver = w
    clear_rows(quadrics)
    for r in range(3):
        i, j = (0, 1) if r == 0 else ((0, 2) if r == 1 else (1, 2))
        cosine, along_i, along_j, apart, distance = 0.0, 0.0, 0.0, 0.0, 0.0
        for c in range(3):
            o = origins[i, c] - origins[j, c]
            cosine += rays[i, c] * rays[j, c]
            along_i += o * rays[i, c]
            along_j += o * rays[j, c]
            apart += o * o
            distance += (points[i, c] - points[j, c]) ** 2
        if not distance > 0.0:
            return 0
        # x2 xy xz y2 yz z2 x y z 1 of the depths of rays 0, 1, 2, in units of the distance.
        square_i, square_j = (0, 3) if r == 0 else ((0, 5) if r == 1 else (3, 5))
        product = 1 if r == 0 else (2 if r == 1 else 4)
        quadrics[r, square_i] = quadrics[r, square_j] = 1.0
        quadrics[r, product] = -2.0 * cosine
        quadrics[r, 6 + i], quadrics[r, 6 + j] = 2.0 * along_i, -2.0 * along_j
        quadrics[r, 9] = apart - distance
    found = 0
    for k in range(intersect_quadrics(quadrics, solutions, solver)):
        if solutions[k, 0] > 0.0 and solutions[k, 1] > 0.0 and solutions[k, 2] > 0.0:
            for i in range(3):
                for c in range(3):
                    seen[i, c] = origins[i, c] + solutions[k, i] * rays[i, c]
            if align_three_points(points, seen, False, a, b, motions[found]):
                found += 1
    return found


@kernel(allocates=True)
def generalized_p3p_workspace():
    """Working arrays of `generalized_p3p`."""
    return (
        np.empty((3, 10)),
        np.empty((8, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        quadrics_workspace(),
    )


@kernel
def _product(x, y, first, out, sign):
    """Out += sign (x . y) as a quadric, for vectors of three entries from `first` on, linear in (x, y, z, 1)."""
    position = ((0, 1, 2, 6), (1, 3, 4, 7), (2, 4, 5, 8), (6, 7, 8, 9))
    for i in range(4):
        for j in range(4):
            total = 0.0
            for c in range(3):
                total += x[i, first + c] * y[j, c]
            out[position[i][j]] += sign * total


@kernel
def p4pf(pixels, points, models, w):
    """Pose and focal length from four points at pixels relative to the principal point.

    P ~ diag(f, f, 1) [R t]. The lines through the principal point, v (p1 . X) = u (p2 . X), leave a four-dimensional space for
    the first two rows of P; the third follows linearly; r1 . r2 = 0, |r1| = |r2| and r3 . (r1 + r2) = 0 are three quadrics
    (Bujnak, Kukelova and Pajdla, CVPR 2008; in this form Larsson, Kukelova and Zheng, ICCV 2017). Assumes square pixels, no
    distortion, and normalized, non-coplanar points. Writes up to eight models (R, t, f); returns their number.
    """
    lines, basis, third, inverse, quadrics, solutions, rows, solver = w
    for k in range(4):
        u, v = pixels[k, 0], pixels[k, 1]
        for c in range(4):
            x = points[k, c] if c < 3 else 1.0
            lines[k, c], lines[k, 4 + c] = v * x, -u * x
            inverse[k, c] = x
            inverse[k, 4 + c] = 1.0 if c == k else 0.0
    null_space(lines, basis)
    if not reduce_rows(inverse):
        return 0
    # (u^2 + v^2) (p3 . X) = u (p1 . X) + v (p2 . X) for each point gives the third row of every basis vector.
    for m in range(4):
        for c in range(4):
            third[m, c] = 0.0
        for k in range(4):
            u, v = pixels[k, 0], pixels[k, 1]
            square = u * u + v * v
            if not square > 1e-12:
                return 0
            value = u * basis[m, 3] + v * basis[m, 7]
            for c in range(3):
                value += (u * basis[m, c] + v * basis[m, 4 + c]) * points[k, c]
            for c in range(4):
                third[m, c] += inverse[c, 4 + k] * value / square
    clear_rows(quadrics)
    _product(basis, basis[:, 4:7], 0, quadrics[0], 1.0)
    _product(basis, basis[:, 0:3], 0, quadrics[1], 1.0)
    _product(basis, basis[:, 4:7], 4, quadrics[1], -1.0)
    _product(basis, third[:, 0:3], 0, quadrics[2], 1.0)
    _product(basis, third[:, 0:3], 4, quadrics[2], 1.0)
    found = 0
    for k in range(intersect_quadrics(quadrics, solutions, solver)):
        for c in range(4):
            rows[0, c] = rows[1, c] = rows[2, c] = 0.0
            for m in range(4):
                factor = solutions[k, m] if m < 3 else 1.0
                rows[0, c] += factor * basis[m, c]
                rows[1, c] += factor * basis[m, 4 + c]
                rows[2, c] += factor * third[m, c]
        if _model_of_rows(rows, points, models[found]):
            found += 1
    return found


@kernel
def _model_of_rows(rows, points, out):
    """(R, t, f) of P = s diag(f, f, 1) [R t], with the first point in front."""
    size1 = math.sqrt(rows[0, 0] ** 2 + rows[0, 1] ** 2 + rows[0, 2] ** 2)
    size3 = math.sqrt(rows[2, 0] ** 2 + rows[2, 1] ** 2 + rows[2, 2] ** 2)
    if not (size1 > 0.0 and size3 > 1e-12 * size1):
        return False
    depth = rows[2, 3]
    for c in range(3):
        depth += rows[2, c] * points[0, c]
    sign = 1.0 if depth > 0.0 else -1.0
    focal = size1 / size3
    if not (focal > 1e-3 and focal < 1e3):
        return False
    for c in range(3):
        out[6 + c] = sign * rows[2, c] / size3
        out[c] = sign * rows[0, c]
    # Gram-Schmidt from the third row, then the first; the second is their cross product.
    dot = out[0] * out[6] + out[1] * out[7] + out[2] * out[8]
    norm = 0.0
    for c in range(3):
        out[c] -= dot * out[6 + c]
        norm += out[c] * out[c]
    norm = math.sqrt(norm)
    if not norm > 1e-6 * size1:
        return False
    for c in range(3):
        out[c] /= norm
    for c in range(3):
        i, j = (c + 1) % 3, (c + 2) % 3
        out[3 + c] = out[6 + i] * out[j] - out[6 + j] * out[i]
    # A second row with the opposite sign belongs to a mirrored camera.
    if sign * (out[3] * rows[1, 0] + out[4] * rows[1, 1] + out[5] * rows[1, 2]) <= 0.0:
        return False
    out[9], out[10] = sign * rows[0, 3] / (focal * size3), sign * rows[1, 3] / (focal * size3)
    out[11] = sign * rows[2, 3] / size3
    out[FOCAL] = focal
    return True


@kernel(allocates=True)
def p4pf_workspace():
    """Working arrays of `p4pf`."""
    return (
        np.empty((4, 8)),
        np.empty((4, 8)),
        np.empty((4, 4)),
        np.empty((4, 8)),
        np.empty((3, 10)),
        np.empty((8, 3)),
        np.empty((3, 4)),
        quadrics_workspace(),
    )


@kernel
def _rotation_about_y(cos, sin, out):
    out[0], out[1], out[2] = cos, 0.0, sin
    out[3], out[4], out[5] = 0.0, 1.0, 0.0
    out[6], out[7], out[8] = -sin, 0.0, cos


@kernel
def upright_p2p(rays, points, motions):
    """cam_from_world of a camera with the world's y axis, from two points: l_i d_i = R_y X_i + t, l_i > 0.

    l2 d2 - l1 d1 = R_y (X2 - X1): the heights give one depth from the other, the horizontal length a quadratic (Kukelova,
    Bujnak and Pajdla, ACCV 2010). Assumes that at least one ray is not horizontal. Writes up to two motions.
    """
    dx, dy, dz = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2]
    # l_q = start + slope l_p, where q is the steeper ray.
    steep = 1 if abs(rays[1, 1]) >= abs(rays[0, 1]) else 0
    flat = 1 - steep
    if not abs(rays[steep, 1]) > 1e-9:
        return 0
    sign = 1.0 if steep == 1 else -1.0  # l_steep d_steep - l_flat d_flat = sign R D
    start, slope = sign * dy / rays[steep, 1], rays[flat, 1] / rays[steep, 1]
    ax, az = start * rays[steep, 0], start * rays[steep, 2]
    bx, bz = slope * rays[steep, 0] - rays[flat, 0], slope * rays[steep, 2] - rays[flat, 2]
    a, b = bx * bx + bz * bz, ax * bx + az * bz
    c = ax * ax + az * az - dx * dx - dz * dz
    discriminant = b * b - a * c
    across = dx * dx + dz * dz
    if not (discriminant >= 0.0 and a > 1e-300 and across > 1e-300):
        return 0
    found, root = 0, math.sqrt(discriminant)
    for side in (-1.0, 1.0):
        depth = (-b + side * root) / a
        other = start + slope * depth
        if not (depth > 0.0 and other > 0.0):
            continue
        vx, vz = sign * (ax + depth * bx), sign * (az + depth * bz)
        cos, sin = (dx * vx + dz * vz) / across, (vx * dz - vz * dx) / across
        norm = math.sqrt(cos * cos + sin * sin)
        out = motions[found]
        _rotation_about_y(cos / norm, sin / norm, out)
        first = depth if flat == 0 else other
        for i in range(3):
            moved = out[3 * i] * points[0, 0] + out[3 * i + 1] * points[0, 1] + out[3 * i + 2] * points[0, 2]
            out[9 + i] = first * rays[0, i] - moved
        found += 1
    return found


@kernel
def upright_relative_three_point(y1, y2, motions, w):
    """cam2_from_cam1, |t| = 1, of two cameras with a common vertical y axis, from three matches.

    t . (R_y y1 x y2) = 0 for each; with q = tan(angle / 2), (1 + q^2) R_y is quadratic in q, and the determinant of the three
    rows, of degree six, vanishes (Fraundorfer, Tanskanen and Pollefeys, ECCV 2010; Sweeney, Flynn and Turk, 3DV 2014). Writes up
    to twelve motions (both signs of t); returns their number.
    """
    rows, poly, minor, roots, root_work = w
    for k in range(3):
        a, b, c = y1[k, 0], y1[k, 1], y1[k, 2]
        u, v, s = y2[k, 0], y2[k, 1], y2[k, 2]
        # (1 + q^2) R_y y1 = (a + c) ... = p0 + p1 q + p2 q^2
        for d in range(3):
            x = a if d == 0 else (2.0 * c if d == 1 else -a)
            y = b if d == 0 else (0.0 if d == 1 else b)
            z = c if d == 0 else (-2.0 * a if d == 1 else -c)
            rows[k, 0, d], rows[k, 1, d], rows[k, 2, d] = y * s - z * v, z * u - x * s, x * v - y * u
    clear(poly)
    for column in range(3):
        p, q = (column + 1) % 3, (column + 2) % 3
        clear(minor)
        for i in range(3):
            for j in range(3):
                minor[i + j] += rows[0, p, i] * rows[1, q, j] - rows[0, q, i] * rows[1, p, j]
        for i in range(5):
            for j in range(3):
                poly[i + j] += minor[i] * rows[2, column, j]
    found = 0
    for k in range(real_roots(poly, root_work, roots)):
        found = _directions_at(rows, roots[k], motions, found)
    return found


@kernel
def _directions_at(rows, q, motions, found):
    """Both signs of the direction orthogonal to the three rows at q, with their rotation."""
    best, tx, ty, tz = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        a0 = rows[a, 0, 0] + q * (rows[a, 0, 1] + q * rows[a, 0, 2])
        a1 = rows[a, 1, 0] + q * (rows[a, 1, 1] + q * rows[a, 1, 2])
        a2 = rows[a, 2, 0] + q * (rows[a, 2, 1] + q * rows[a, 2, 2])
        b0 = rows[b, 0, 0] + q * (rows[b, 0, 1] + q * rows[b, 0, 2])
        b1 = rows[b, 1, 0] + q * (rows[b, 1, 1] + q * rows[b, 1, 2])
        b2 = rows[b, 2, 0] + q * (rows[b, 2, 1] + q * rows[b, 2, 2])
        x, y, z = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        size = x * x + y * y + z * z
        if size > best:
            best, tx, ty, tz = size, x, y, z
    if not best > 1e-300 or found + 2 > len(motions):
        return found
    scale, norm = 1.0 / (1.0 + q * q), 1.0 / math.sqrt(best)
    for side in (1.0, -1.0):
        out = motions[found]
        _rotation_about_y((1.0 - q * q) * scale, 2.0 * q * scale, out)
        out[9], out[10], out[11] = side * tx * norm, side * ty * norm, side * tz * norm
        found += 1
    return found


@kernel(allocates=True)
def upright_relative_workspace():
    """Working arrays of `upright_relative_three_point`."""
    return np.empty((3, 3, 3)), np.empty(7), np.empty(5), np.empty(7), roots_workspace()
