"""Tracks: choose, triangulate, extend and filter, one component of matches at a time.

A component is a set of keypoints connected by verified matches, at most one per image; its rows are consecutive. It
may yield several points, as a false match can join two.
"""

import math

import numpy as np

from epipole._jit import kernel
from epipole.cameras._camera_kernels import NUM_PARAMS
from epipole.robust._triangulation_kernels import (
    best_hypothesis,
    collect_inliers,
    cosine_at,
    error_sq,
    min_cosine,
    polish_point,
)

NEAREST_SQ = 1e-12  # squared fraction of the farthest view's distance


@kernel
def cover_images(offsets, image, is_member, order, per_image, count, chosen):
    """Choose components in the given order if one of their member images has fewer than `per_image` observations."""
    for t in order:
        is_needed = False
        for row in range(offsets[t], offsets[t + 1]):
            is_needed = is_needed or (is_member[image[row]] and count[image[row]] < per_image)
        if is_needed:
            chosen[t] = True
            for row in range(offsets[t], offsets[t + 1]):
                count[image[row]] += 1


@kernel
def cover_cells(offsets, image, cell, order, min_new, is_covered, chosen):
    """Choose points in the given order if `min_new` of their observations, and two, lie in cells without a chosen point.

    `is_covered` (images, cells) is updated.
    """
    for j in order:
        num_new = 0
        for row in range(offsets[j], offsets[j + 1]):
            num_new += not is_covered[image[row], cell[row]]
        if num_new < 2 or num_new < min_new * (offsets[j + 1] - offsets[j]):
            continue
        chosen[j] = True
        for row in range(offsets[j], offsets[j + 1]):
            is_covered[image[row], cell[row]] = True


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
    """Triangulate points from the rows of components[start:stop] that have none.

    new_points (m, 3) receives the points, new_point_of_row their index there (-1 for none); returns m.
    """
    free, chosen, best_x = np.empty(longest, np.int64), np.empty(longest, np.int64), np.empty(3)
    work = (np.empty(3), np.empty(3), np.empty(3), np.empty(longest, np.int64))
    jac, jac_params = np.empty((2, 3)), np.empty((2, NUM_PARAMS))
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
            if best_hypothesis(rows, cams, free, count, max_error_sq, max_cosine, work, best_x) < 2:
                break
            found, _total = collect_inliers(rows, cams, free, count, best_x, max_error_sq, chosen)
            polish_point(rows, cams, chosen, found, best_x, jac, jac_params)
            found, _total = collect_inliers(rows, cams, free, count, best_x, max_error_sq, chosen)
            if found < 2 or min_cosine(rows, cams, chosen, found, best_x) > max_cosine:
                break
            new_points[made] = best_x
            for m in range(found):
                new_point_of_row[chosen[m]] = made
            made += 1
    return made


@kernel
def extend_components(rows, cams, offsets, components, start, stop, points, max_error_sq, new_point_of_row):
    """Assign rows without a point to the nearest point of their component; returns the number of assigned rows."""
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
                e = error_sq(rows, cams, k, points[j, 0], points[j, 1], points[j, 2])
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
def _distance_sq(cams, i, x):
    p, q, r = cams.center[i, 0] - x[0], cams.center[i, 1] - x[1], cams.center[i, 2] - x[2]
    return p * p + q * q + r * r


@kernel
def filter_points(
    rows, cams, row_offsets, row_order, start, stop, points, max_error_sq, max_cosine, keep_row, errors
):
    """Mark the rows to keep for points start..stop; a point with one row or too narrow an angle loses all of them.

    A row is dropped if the point coincides with its camera center: adjustment can fit any pixel there, and depth and
    angle are rounding noise. row_order lists rows grouped by point. errors receives the mean error of the kept rows,
    NaN for a removed point.
    """
    for j in range(start, stop):
        first, last = row_offsets[j], row_offsets[j + 1]
        kept, total, least, farthest_sq = 0, 0.0, 1.0, 0.0
        for n in range(first, last):
            k = row_order[n]
            e = error_sq(rows, cams, k, points[j, 0], points[j, 1], points[j, 2])
            keep_row[k] = e < max_error_sq
            if keep_row[k]:
                kept += 1
                total += math.sqrt(e)
                farthest_sq = max(farthest_sq, _distance_sq(cams, rows.image[k], points[j]))
        for n in range(first, last):
            k = row_order[n]
            if keep_row[k] and _distance_sq(cams, rows.image[k], points[j]) <= NEAREST_SQ * farthest_sq:
                keep_row[k] = False
                kept -= 1
                total -= math.sqrt(error_sq(rows, cams, k, points[j, 0], points[j, 1], points[j, 2]))
        if kept >= 2:
            for n in range(first, last):
                for m in range(first, n):
                    if least > max_cosine and keep_row[row_order[n]] and keep_row[row_order[m]]:
                        a, b = rows.image[row_order[n]], rows.image[row_order[m]]
                        least = min(least, cosine_at(cams, a, b, points[j]))
        if kept < 2 or least > max_cosine:
            for n in range(first, last):
                keep_row[row_order[n]] = False
            errors[j] = math.nan
        else:
            errors[j] = total / kept
