"""The observations of an image's neighbors: for each point, the one from the most similar direction."""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel

NOT_FOUND, SEEN = -1, -2


class Observations(NamedTuple):
    """Observations of a model by point, and the same by image."""

    point: np.ndarray  # (k,) int32
    image: np.ndarray  # (k,) int32
    keypoint: np.ndarray  # (k,) int32
    to_camera: np.ndarray  # (k, 3) unit vector from the point to the camera
    by_image: np.ndarray  # (k,) int64
    starts: np.ndarray  # (n + 1,) int64, of each image in `by_image`


@kernel
def closest_views(observed, image, neighbors, center, points, min_cosine, best, cosine, found):
    """Write to `found` the observations by `neighbors`, one for each point that `image` does not observe: v . (c - X) / |c - X| is largest.

    Of equal ones, the first. `best` (points,) must be NOT_FOUND, and is so afterwards; `cosine` (points,) is scratch. Returns their number.
    """
    count = 0
    for k in range(observed.starts[image], observed.starts[image + 1]):
        best[observed.point[observed.by_image[k]]] = SEEN
    for n in neighbors:
        for k in range(observed.starts[n], observed.starts[n + 1]):
            row = observed.by_image[k]
            j = observed.point[row]
            if best[j] == SEEN:
                continue
            x, y, z = center[0] - points[j, 0], center[1] - points[j, 1], center[2] - points[j, 2]
            away = observed.to_camera[row]
            dot = x * away[0] + y * away[1] + z * away[2]
            value = dot / max(math.sqrt(x * x + y * y + z * z), 1e-300)
            if best[j] == NOT_FOUND:
                found[count] = j
                count += 1
                best[j], cosine[j] = row, value
            elif value > cosine[j] or (value == cosine[j] and row < best[j]):
                best[j], cosine[j] = row, value
    for k in range(observed.starts[image], observed.starts[image + 1]):
        best[observed.point[observed.by_image[k]]] = NOT_FOUND
    kept = 0
    for at in range(count):
        j = found[at]
        if cosine[j] >= min_cosine:
            found[kept] = best[j]
            kept += 1
        best[j] = NOT_FOUND
    return np.int64(kept)
