"""The pairs that mapping uses: those that do not contradict the others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole._checks import Declared
from epipole.mapping import check_rotation_cycles
from epipole.pipelines.sfm.config import MapperConfig
from epipole.robust import PairKind
from epipole.scene import ViewGraph


@dataclass(frozen=True, slots=True, eq=False)
class ContradictingPairs(Declared):
    """Pairs whose images probably show different things that look alike."""

    view_graph: ViewGraph
    angle_rad: Float64[np.ndarray, " n"]
    """Angle between the pair's rotation and the one that the other pairs imply."""

    def __len__(self) -> int:
        return len(self.view_graph)

    def __repr__(self) -> str:
        return f"ContradictingPairs({len(self)} pairs)"


def consistent_pairs(
    view_graph: ViewGraph, num_images: int, config: MapperConfig
) -> tuple[ViewGraph, ContradictingPairs]:
    """Separate the pairs that contradict the others.

    A pair with a guessed focal length has no rotation to compare, and stays.
    """
    is_calibrated = view_graph.kind != PairKind.UNCALIBRATED
    limit_rad = np.deg2rad(config.max_contradiction_deg)
    consistency = check_rotation_cycles(view_graph, num_images, is_calibrated, limit_rad)
    dropped = consistency.contradicts
    found = ContradictingPairs(view_graph.select(dropped), consistency.angle_rad[dropped])
    return view_graph.select(~dropped), found
