"""Views of neighboring points: what an image with a similar view of a point sees of the point and of its neighbors."""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel

COMMON, MISSED, CONFLICTING = 0, 1, 2
NUM_KINDS = 3
NOT_MARKED = -1


class Views(NamedTuple):
    """Images that see each point, once each."""

    offsets: np.ndarray  # (p + 1,) int64
    image: np.ndarray  # (k,) int64
    ray: np.ndarray  # (k, 3) from the camera center to the point


class Scratch(NamedTuple):
    """Memory for the images of one point."""

    mark: np.ndarray  # (n,) int8, NOT_MARKED between the calls
    marked: np.ndarray  # (n,) int64


@kernel
def collect_views(views, xyz, centers, neighbors, points, limits, scratch, key):
    """Writes a key for each ordered pair of images i, j with similar views of a point p that i sees: 3 (min(i, j) n + max(i, j)) + kind.

    The kind is COMMON if j sees p, too. If j sees neighbors of p, it is MISSED if one of them has an image in common with p, and
    CONFLICTING if none has.
    `points` is the range of p, `neighbors` (p, m) ends with -1, and `limits` are the least cosine of the angle between the views and the
    largest ratio of the distances. Returns the number of keys, of which only those that fit into `key` are written.
    """
    num_images, count = len(centers), 0
    mark, marked = scratch.mark, scratch.marked
    for p in range(points[0], points[1]):
        num_marked = _mark(views, neighbors[p], p, mark, marked)
        for k in range(views.offsets[p], views.offsets[p + 1]):
            i = views.image[k]
            for m in range(num_marked):
                j = marked[m]
                if j == i or not _is_similar(views.ray[k], xyz[p], centers[j], limits):
                    continue
                if count < len(key):
                    key[count] = NUM_KINDS * (min(i, j) * num_images + max(i, j)) + mark[j]
                count += 1
        for m in range(num_marked):
            mark[marked[m]] = NOT_MARKED
    return count


@kernel
def _mark(views, neighbors, p, mark, marked):
    """Marks the images that see point p or its neighbors; returns their number."""
    num_marked = 0
    for k in range(views.offsets[p], views.offsets[p + 1]):
        mark[views.image[k]] = COMMON
        marked[num_marked] = views.image[k]
        num_marked += 1
    for q in neighbors:
        if q < 0:
            break
        kind = CONFLICTING
        for k in range(views.offsets[q], views.offsets[q + 1]):
            if mark[views.image[k]] == COMMON:
                kind = MISSED
        for k in range(views.offsets[q], views.offsets[q + 1]):
            j = views.image[k]
            if mark[j] == NOT_MARKED:
                mark[j] = kind
                marked[num_marked] = j
                num_marked += 1
            elif mark[j] == CONFLICTING:
                mark[j] = kind
    return num_marked


@kernel
def _is_similar(ray, point, center, limits):
    """Whether a point is seen from a similar direction and distance along `ray` and from `center`."""
    x, y, z = point[0] - center[0], point[1] - center[1], point[2] - center[2]
    length = math.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
    other = math.sqrt(x * x + y * y + z * z)
    is_same_side = ray[0] * x + ray[1] * y + ray[2] * z > limits[0] * length * other
    return is_same_side and max(length, other) < limits[1] * min(length, other)
