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
    image: np.ndarray  # (k,) int64, in ascending order for each point
    ray: np.ndarray  # (k, 3) from the camera center to the point


class Scratch(NamedTuple):
    """Memory for the images of one point."""

    mark: np.ndarray  # (n,) int8, NOT_MARKED between the calls
    marked: np.ndarray  # (n,) int64


@kernel
def count_views(views, xyz, centers, neighbors, block, limits, scratch, counts):
    """Counts, for each image i of a block and each image j, the points p that i sees and that j sees or would see similarly.

    The kind is COMMON if j sees p, too. If j sees neighbors of p, it is MISSED if one of them has an image in common with p, and
    CONFLICTING if none has.
    `neighbors` (p, m) ends with -1, `block` is the range of i, `limits` are the least cosine of the angle between the views and the
    largest ratio of the distances, and `counts` is (i, j, kind).
    """
    mark, marked = scratch.mark, scratch.marked
    for p in range(len(xyz)):
        first, last = views.offsets[p], views.offsets[p + 1]
        while first < last and views.image[first] < block[0]:
            first += 1
        while first < last and views.image[last - 1] >= block[1]:
            last -= 1
        if first == last:
            continue
        num_marked = _mark(views, neighbors[p], p, mark, marked)
        for k in range(first, last):
            i = views.image[k]
            for m in range(num_marked):
                j = marked[m]
                if j != i and _is_similar(views.ray[k], xyz[p], centers[j], limits):
                    counts[i - block[0], j, mark[j]] += 1
        for m in range(num_marked):
            mark[marked[m]] = NOT_MARKED


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
