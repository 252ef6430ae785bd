"""Camera poses optimized with the field (Lin et al., "BARF: Bundle-adjusting neural radiance fields", ICCV 2021)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from epipole._checks.tables import Expected, Table
from epipole.fields.rows_adam import RowsAdam
from epipole.geometry import Rigid3

RATES = 1e-3, 1e-5
"""Learning rate at the start and at the end: radians for rotation, fraction of the scene size for translation."""


class PoseSteps:
    """Poses being optimized.

    Attributes:
        cams_from_world: current pose of each camera.
    """

    def __init__(self, cams_from_world: Sequence[Rigid3], size: float) -> None:
        self.cams_from_world = list(cams_from_world)
        self._unit = np.repeat([size, 1.0], 3)
        self._adam = RowsAdam(len(self.cams_from_world), 6, RATES)

    def move(self, view: int, gradient: np.ndarray, progress: float) -> None:
        """Update one pose; gradient (6,) is w.r.t. xi = (translation, rotation) in exp(xi) @ cam_from_world."""
        xi = self._unit * self._adam.step(view, self._unit * gradient, progress)
        self.cams_from_world[view] = Rigid3.exp(xi) @ self.cams_from_world[view]

    @property
    def table(self) -> Table:
        """Arrays of `state`."""
        count = len(self.cams_from_world)
        return {
            "pose_rotation": Expected("float64", f"{count} 3 3", is_rotation=True),
            "pose_translation": Expected("float64", f"{count} 3"),
            **self._adam.table("pose"),
        }

    def state(self) -> dict[str, np.ndarray]:
        """All state that the next steps depend on."""
        rotations = np.stack([position.rotation for position in self.cams_from_world])
        translations = np.stack([position.translation for position in self.cams_from_world])
        return {"pose_rotation": rotations, "pose_translation": translations, **self._adam.state("pose")}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state`."""
        parts = zip(state["pose_rotation"], state["pose_translation"])
        self.cams_from_world = [Rigid3(rotation, translation) for rotation, translation in parts]
        self._adam.restore("pose", state)
