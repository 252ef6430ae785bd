"""Whether depth can be metres at all: a wrong unit (millimetres for metres, TUM's 5000 for 1000) is told."""

from __future__ import annotations

import numpy as np

NEAREST_M, FARTHEST_M = 0.05, 100.0
USUAL_M = 0.3, 10.0
"""Median depths of what depth cameras are carried through: beyond, a factor of ten is likelier than the place."""
_STEP = 4


class DepthRange:
    """The median depth of each frame.

    A factor on all depths of registered images is seen nowhere else: map and path grow by it, and agree.
    """

    def __init__(self) -> None:
        self._medians_m: list[float] = []

    def add(self, depth_m: np.ndarray) -> None:
        """Take the median of a depth image: metres, 0 or NaN where unknown."""
        sample = depth_m[::_STEP, ::_STEP]
        known = sample[np.isfinite(sample) & (sample > 0)]
        if len(known):
            self._medians_m.append(float(np.median(known)))

    def notes(self) -> list[str]:
        """A warning where no depth camera measures like that; empty where all is well."""
        if not self._medians_m:
            return []
        median_m = float(np.median(self._medians_m))
        if USUAL_M[0] <= median_m <= USUAL_M[1]:
            return []
        if NEAREST_M <= median_m <= FARTHEST_M:
            return [
                f"the median depth is {median_m:.3g} m, unusual for a depth camera ({USUAL_M[0]:g} to {USUAL_M[1]:g} m): is"
                " the unit of the depth images right? A factor on all depths is one on all lengths of path and map"
            ]
        return [
            f"the median depth is {median_m:.4g} m, no depth camera's ({NEAREST_M:g} to {FARTHEST_M:g} m): the unit "
            "of the depth images is probably wrong, and with it all lengths"
        ]
