"""View graphs for tests of the mappers."""

import numpy as np

from epipole.geometry import Rigid3
from epipole.robust import PairKind
from epipole.scene import ViewGraph


def graph_of_rotations(pairs, rotations, num_matches):
    """Pairs with relative rotations and so many matches, of keypoints with the same number."""
    n = len(pairs)
    unknown = np.full((n, 3, 3), np.nan)
    keypoints = np.concatenate([np.arange(k) for k in num_matches]).astype(np.int32)
    first, second = np.array(pairs, np.int32).T
    return ViewGraph(
        first.copy(),
        second.copy(),
        np.full(n, int(PairKind.GENERAL), np.int32),
        np.asarray(num_matches, np.int32),
        np.concatenate([[0], np.cumsum(num_matches)]).astype(np.int64),
        keypoints,
        keypoints.copy(),
        Rigid3(rotations, np.tile([1.0, 0.0, 0.0], (n, 1))),
        *(unknown, unknown, unknown),
        np.full(n, 0.2),
    )
