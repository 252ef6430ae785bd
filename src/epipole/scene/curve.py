"""Lines to display in the world: camera trajectories, and edges between positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from epipole._checks import Declared, checked
from epipole.geometry import Similarity3


@dataclass(frozen=True, slots=True, eq=False)
class Curve(Declared):
    """Line segments with one name and one color."""

    name: str
    segments_in_world: Float64[np.ndarray, "n 2 3"]
    """Start and end of each segment."""
    rgb: tuple[int, int, int]
    is_shown: bool = True
    """Initial visibility, where the user can choose."""

    @checked
    def transformed(self, target_from_world: Similarity3) -> Curve:
        """The same lines in another frame."""
        moved = target_from_world.apply(self.segments_in_world.reshape(-1, 3)).reshape(-1, 2, 3)
        return Curve(self.name, moved, self.rgb, self.is_shown)

    def __repr__(self) -> str:
        return f"Curve({self.name!r}, {len(self.segments_in_world)} segments)"


@checked
def path_segments(
    points_in_world: Float64[np.ndarray, "n 3"], is_joined: Bool[np.ndarray, " n"]
) -> Float64[np.ndarray, "k 2 3"]:
    """Segments from each point to the next.

    Args:
        points_in_world: the points in order.
        is_joined: whether a point is connected to the previous one; the first row is ignored.
    """
    ends = np.flatnonzero(is_joined[1:]) + 1
    return np.stack([points_in_world[ends - 1], points_in_world[ends]], axis=1)
