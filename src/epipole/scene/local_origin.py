"""An origin near the points, for computation or storage in single precision."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked

ORIGIN = "origin_in_world"
"""Name of the offset in a file's header or metadata; add it to the file's coordinates."""
FAR = 30.0
"""Distance from the origin, in units of the points' spread, above which float32 resolves only 2e-6 of the spread."""

_FAR_OF_ONE = 1e4
"""Distance from the origin above which a single point counts as far."""


@checked
def local_origin(points_in_world: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " 3"]:
    """An origin near points far from zero (such as UTM): their median, rounded to at most a tenth of their spread.

    Zero if they are near the origin, so most scenes are unchanged. Non-finite points are ignored.
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
