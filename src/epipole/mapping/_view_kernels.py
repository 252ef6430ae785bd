"""The observations of an image's neighbors: for each point, the one from the most similar direction."""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel


class Observations(NamedTuple):
    """Observations of a model, and their order by image and by point."""

    point: np.ndarray  # (k,) int32
    image: np.ndarray  # (k,) int32
    to_camera: np.ndarray  # (k, 3) unit vector from the point to the camera
    by_image: np.ndarray  # (k,) int64
    image_starts: np.ndarray  # (n + 1,) int64, of each image in `by_image`
    by_point: np.ndarray  # (k,) int64
    point_starts: np.ndarray  # (p + 1,) int64, of each point in `by_point`


@kernel
def closest_views(observed, image, neighbors, center, points, min_cosine, is_noted, is_neighbor, found):
    """Write to `found` the observations by `neighbors`, one for each point that `image` does not observe: v . (c - X) / |c - X| is largest.

    Of equal ones, the first; `image` -1 observes nothing. `is_noted` (points,) and `is_neighbor` (images,) must be False, and are so
    afterwards. Returns their number.
    """
    starts, count = observed.image_starts, 0
    own = range(starts[image], starts[image + 1]) if image >= 0 else range(0, 0)
    for k in own:
        is_noted[observed.point[observed.by_image[k]]] = True
    for n in neighbors:
        is_neighbor[n] = True
        for k in range(starts[n], starts[n + 1]):
            j = observed.point[observed.by_image[k]]
            if not is_noted[j]:
                is_noted[j] = True
                found[count] = j
                count += 1
    kept = 0
    for at in range(count):
        j = found[at]
        is_noted[j] = False
        x, y, z = center[0] - points[j, 0], center[1] - points[j, 1], center[2] - points[j, 2]
        best, largest = -1, min_cosine * max(math.sqrt(x * x + y * y + z * z), 1e-300)
        for k in range(observed.point_starts[j], observed.point_starts[j + 1]):
            row = observed.by_point[k]
            away = observed.to_camera[row]
            dot = x * away[0] + y * away[1] + z * away[2]
            if is_neighbor[observed.image[row]] and (dot > largest or (best < 0 and dot == largest)):
                best, largest = row, dot
        if best >= 0:
            found[kept] = best
            kept += 1
    for k in own:
        is_noted[observed.point[observed.by_image[k]]] = False
    for n in neighbors:
        is_neighbor[n] = False
    return np.int64(kept)
