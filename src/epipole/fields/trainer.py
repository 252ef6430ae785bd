"""Interface of all trainers: Gaussians, voxel grids, hash grids."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np

from epipole._checks.tables import Table
from epipole.fields.training_view import TrainingView


@runtime_checkable
class Trainer(Protocol):
    """Trains one field on the views that it was made with."""

    background: np.ndarray
    """(3,) color behind the field."""
    num_steps: int

    @property
    def field(self) -> Any:
        """The current field: a GaussianCloud, Voxels or a HashField."""

    def step(self, progress: float) -> float:
        """Take one step at a fraction of the training, from 0 to 1; return the loss."""

    def render(self, view: TrainingView) -> np.ndarray:
        """(h, w, 3) image of a view."""

    def render_counted(self, view: TrainingView) -> tuple[np.ndarray, int]:
        """(h, w, 3) image of a view, and the number of evaluations that it took."""

    @property
    def table(self) -> Table:
        """Types and shapes of the arrays in `state`."""

    def state(self) -> dict[str, np.ndarray]:
        """All that later steps depend on, besides the views."""

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state`.

        Raises:
            ShapeError: its arrays do not fit the table or each other.
        """

    def __len__(self) -> int:
        """Number of Gaussians, voxels or parameters."""
