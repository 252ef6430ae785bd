"""The observations of an image's neighbors: for each point, the one from the most similar direction."""

import math
from typing import NamedTuple

import numpy as np

from epipole._jit import kernel

NOT_FOUND, SEEN = -1, -2


class Observations(NamedTuple):
    """Observations of a model, sorted by image: neighbors are read one after the other, without a jump for each observation."""

    point: np.ndarray  # (k,) int32
    to_camera: np.ndarray  # (k, 3) unit vector from the point to the camera
    starts: np.ndarray  # (n + 1,) int64, the first of each image


@kernel
def closest_views(observed, image, neighbors, center, points, min_cosine, best, cosine, found):
    """Write to `found` the observations by `neighbors`, one for each point that `image` does not observe: v . (c - X) / |c - X| is largest.

    Of equal ones, the first; `image` -1 observes nothing. `best` (points,) must be NOT_FOUND, and is so afterwards; `cosine` (points,) is
    scratch. Returns their number.
    """
    starts, count = observed.starts, 0
    own = range(starts[image], starts[image + 1]) if image >= 0 else range(0, 0)
    for row in own:
        best[observed.point[row]] = SEEN
    for n in neighbors:
        for row in range(starts[n], starts[n + 1]):
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
    for row in own:
        best[observed.point[row]] = NOT_FOUND
    kept = 0
    for at in range(count):
        j = found[at]
        if cosine[j] >= min_cosine:
            found[kept] = best[j]
            kept += 1
        best[j] = NOT_FOUND
    return np.int64(kept)
