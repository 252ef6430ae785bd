"""An origin near the points, for what is computed or stored in single precision."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from epipole._declared import checked

ORIGIN = "origin_in_world"
"""In a file's header or list of names and values: what is to be added to its coordinates."""
FAR = 30.0
"""Distance from the origin, in the spread of the points, beyond which single precision is coarser than 2e-6 of the spread."""

_FAR_OF_ONE = 1e4
"""Distance beyond which a single point is far."""


@checked
def local_origin(points_in_world: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " 3"]:
    """An origin near points that are far from zero (UTM, for one): their median, rounded to a tenth of their spread or finer.

    Zero where they are near it, so that most scenes stay as they are. Points that are not finite have no part in it.
    """
    points = points_in_world[np.isfinite(points_in_world).all(axis=1)]
    if not len(points):
        return np.zeros(3)
    median = np.median(points, axis=0)
    spread = float(np.median(np.abs(points - median).max(axis=1)))
    if np.abs(median).max() <= (FAR * spread or _FAR_OF_ONE):
        return np.zeros(3)
    step = 10.0 ** np.floor(np.log10(spread)) if spread > 0 else 1.0
    return np.asarray(np.round(median / step) * step)
