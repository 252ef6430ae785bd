"""Plausibility check of depth in meters, to detect a wrong unit (millimeters for meters, TUM's 5000 for 1000)."""

from __future__ import annotations

import numpy as np

NEAREST_M, FARTHEST_M = 0.05, 100.0
USUAL_M = 0.3, 10.0
"""Usual median depths of depth cameras: outside this range, a wrong factor of ten is likelier than such a scene."""
_STEP = 4


class DepthRange:
    """The median depth of each frame.

    Nothing else reveals a factor on all registered depths, since map and trajectory scale with it.
    """

    def __init__(self) -> None:
        self._medians_m: list[float] = []

    def add(self, depth_m: np.ndarray) -> None:
        """Add a depth image in meters, 0 or NaN where unknown."""
        sample = depth_m[::_STEP, ::_STEP]
        known = sample[np.isfinite(sample) & (sample > 0)]
        if len(known):
            self._medians_m.append(float(np.median(known)))

    def notes(self) -> list[str]:
        """A warning if the median depth is implausible."""
        if not self._medians_m:
            return []
        median_m = float(np.median(self._medians_m))
        if USUAL_M[0] <= median_m <= USUAL_M[1]:
            return []
        if NEAREST_M <= median_m <= FARTHEST_M:
            return [
                f"the median depth is {median_m:.3g} m, unusual for a depth camera ({USUAL_M[0]:g} to {USUAL_M[1]:g} m):"
                " check the unit of the depth images, which scales trajectory and map"
            ]
        return [
            f"the median depth is {median_m:.4g} m, outside the range of depth cameras ({NEAREST_M:g} to {FARTHEST_M:g} m):"
            " the unit of the depth images is probably wrong, and with it all lengths"
        ]
