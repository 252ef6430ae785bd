"""Tracks: merging of matches, triangulation, extension and filtering, one component of matches at a time.

A component is a set of keypoints connected by verified matches, one of an image; its rows are consecutive. It may
give several points, for a false match can join two.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import project_one, project_with_jacobian_one

MAX_ROWS_TRIED = 10  # pairs of rows are tried among so many of a component, spread evenly


@kernel
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def connect_without_conflict(row1, row2, image, parent, following, stamp):
    """Union-find over matches in the given order; parent[i] becomes the smallest keypoint row of i's component.

    A match that would put two keypoints of one image into a component is refused: one of the matches behind it
    is wrong, and the earlier ones are the stronger. following links each component's members in a ring; stamp
    (one per image, zero) tells which images a component has.
    """
    for k in range(len(row1)):
        a, b = _root(parent, row1[k]), _root(parent, row2[k])
        if a == b:
            continue
        member = a
        while True:
            stamp[image[member]] = k + 1
            member = following[member]
            if member == a:
                break
        conflict, member = False, b
        while True:
            if stamp[image[member]] == k + 1:
                conflict = True
                break
            member = following[member]
            if member == b:
                break
        if conflict:
            continue
        following[a], following[b] = following[b], following[a]
        if a < b:
            parent[b] = a
        else:
            parent[a] = b
    for i in range(len(parent)):
        parent[i] = _root(parent, i)


@kernel
def _error_sq(rows, cams, k, x, y, z):
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
def _cosine_at(cams, i, j, x):
    """Cosine of the angle at x between the centres of images i and j."""
    a, b = cams.center[i], cams.center[j]
    dot, na, nb = 0.0, 0.0, 0.0
    for c in range(3):
        p, q = a[c] - x[c], b[c] - x[c]
        dot += p * q
        na += p * p
        nb += q * q
    return dot / math.sqrt(na * nb + 1e-300)


@kernel
def _world_ray(rows, cams, k, out):
    """Unit direction of row k in world coordinates."""
    m, r = cams.motion[rows.image[k]], rows.ray[k]
    for c in range(3):
        out[c] = m[c] * r[0] + m[3 + c] * r[1] + m[6 + c] * r[2]


@kernel
def _midpoint(rows, cams, k, l, a, b, x):
    """The midpoint between the rays of two rows into x; False if parallel or behind."""
    _world_ray(rows, cams, k, a)
    _world_ray(rows, cams, l, b)
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
def _collect_inliers(rows, cams, free, count, x, max_error_sq, chosen):
    """The best row of each image that sees x within the bound; returns their number and the sum of errors."""
    found, total = 0, 0.0
    for n in range(count):
        k = free[n]
        e = _error_sq(rows, cams, k, x[0], x[1], x[2])
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
            before = _error_sq(rows, cams, chosen[twin], x[0], x[1], x[2])
            if e < before:
                chosen[twin] = k
                total += e - before
    return found, total


@kernel
def _polish(rows, cams, chosen, count, x, jac, jac_params):
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
def _min_cosine(rows, cams, chosen, count, x):
    """Cosine of the widest angle under which the chosen rows see x."""
    least = 1.0
    for n in range(count):
        for m in range(n):
            least = min(least, _cosine_at(cams, rows.image[chosen[n]], rows.image[chosen[m]], x))
    return least


@kernel
def _best_hypothesis(rows, cams, free, count, max_error_sq, max_cosine, work, best_x):
    """The pair of rows whose midpoint most rows agree with; returns the number of agreeing rows."""
    a, b, x, chosen = work
    best, best_total = 0, math.inf
    step = max(1, (count + MAX_ROWS_TRIED - 1) // MAX_ROWS_TRIED)
    for n in range(0, count, step):
        for m in range(0, n, step):
            k, l = free[n], free[m]
            if rows.image[k] == rows.image[l] or not _midpoint(rows, cams, k, l, a, b, x):
                continue
            if _cosine_at(cams, rows.image[k], rows.image[l], x) > max_cosine:
                continue
            found, total = _collect_inliers(rows, cams, free, count, x, max_error_sq, chosen)
            if found > best or (found == best and total < best_total):
                best, best_total = found, total
                for c in range(3):
                    best_x[c] = x[c]
            if best == count and best_total < 0.25 * max_error_sq * count:
                return best
    return best


@kernel(allocates=True)
def triangulate_components(
    rows,
    cams,
    offsets,
    components,
    start,
    stop,
    max_error_sq,
    max_cosine,
    longest,
    new_points,
    new_point_of_row,
):
    """Make points from the rows without a point of components[start:stop].

    new_points (m, 3) receives the points, new_point_of_row the index there (or -1 untouched); returns m.
    """
    free, chosen, best_x = np.empty(longest, np.int64), np.empty(longest, np.int64), np.empty(3)
    work = (np.empty(3), np.empty(3), np.empty(3), np.empty(longest, np.int64))
    jac, jac_params = np.empty((2, 3)), np.empty((2, 8))
    made = 0
    for n in range(start, stop):
        t = components[n]
        for _ in range(3):
            count = np.int64(0)  # a literal would compile the callees twice
            for k in range(offsets[t], offsets[t + 1]):
                if cams.registered[rows.image[k]] and rows.point[k] < 0 and new_point_of_row[k] < 0:
                    free[count] = k
                    count += 1
            if count < 2 or made == len(new_points):
                break
            if _best_hypothesis(rows, cams, free, count, max_error_sq, max_cosine, work, best_x) < 2:
                break
            found, _total = _collect_inliers(rows, cams, free, count, best_x, max_error_sq, chosen)
            _polish(rows, cams, chosen, found, best_x, jac, jac_params)
            found, _total = _collect_inliers(rows, cams, free, count, best_x, max_error_sq, chosen)
            if found < 2 or _min_cosine(rows, cams, chosen, found, best_x) > max_cosine:
                break
            new_points[made] = best_x
            for m in range(found):
                new_point_of_row[chosen[m]] = made
            made += 1
    return made


@kernel
def extend_components(rows, cams, offsets, components, start, stop, points, max_error_sq, new_point_of_row):
    """Give rows without a point to the nearest point of their own component; returns how many."""
    given = 0
    for n in range(start, stop):
        t = components[n]
        for k in range(offsets[t], offsets[t + 1]):
            if rows.point[k] >= 0 or not cams.registered[rows.image[k]]:
                continue
            best, best_error = -1, max_error_sq
            for l in range(offsets[t], offsets[t + 1]):
                j = rows.point[l]
                if j < 0 or j == best:
                    continue
                e = _error_sq(rows, cams, k, points[j, 0], points[j, 1], points[j, 2])
                if e < best_error:
                    taken = False
                    for m in range(offsets[t], offsets[t + 1]):
                        if rows.image[m] == rows.image[k] and (
                            rows.point[m] == j or new_point_of_row[m] == j
                        ):
                            taken = True
                    if not taken:
                        best, best_error = j, e
            if best >= 0:
                new_point_of_row[k] = best
                given += 1
    return given


@kernel
def filter_points(
    rows, cams, row_offsets, row_order, start, stop, points, max_error_sq, max_cosine, keep_row, errors
):
    """Mark rows of the points start..stop that stay; a point left with one row or a narrow angle loses all.

    row_order lists rows grouped by point. errors receives the mean error of what stays, NaN for a lost point.
    """
    for j in range(start, stop):
        first, last = row_offsets[j], row_offsets[j + 1]
        kept, total, least = 0, 0.0, 1.0
        for n in range(first, last):
            k = row_order[n]
            e = _error_sq(rows, cams, k, points[j, 0], points[j, 1], points[j, 2])
            keep_row[k] = e < max_error_sq
            if keep_row[k]:
                kept += 1
                total += math.sqrt(e)
        if kept >= 2:
            for n in range(first, last):
                for m in range(first, n):
                    if least > max_cosine and keep_row[row_order[n]] and keep_row[row_order[m]]:
                        a, b = rows.image[row_order[n]], rows.image[row_order[m]]
                        least = min(least, _cosine_at(cams, a, b, points[j]))
        if kept < 2 or least > max_cosine:
            for n in range(first, last):
                keep_row[row_order[n]] = False
            errors[j] = math.nan
        else:
            errors[j] = total / kept
