"""Checkpoints, from which an interrupted training continues: the full state in one file, replaced atomically."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from epipole._checks.tables import Expected, Table
from epipole._version import __version__
from epipole.errors import ShapeError, WorkspaceError
from epipole.fields.trainer import Trainer
from epipole.fields.training_view import TrainingView
from epipole.runs.units import digest, is_done, load, store

CHECKPOINT = "checkpoint.npz"
"""File name in the output folder."""
EVERY_S = 60.0
"""Time between two checkpoints."""
_OWN: Table = {
    "seconds": Expected("float64", least=0),
    "curve": Expected("float64", "_ 4", may_be_nan=True),
}


class Checkpoint:
    """Checkpoint file of one job; one of other images, options or another version is ignored."""

    def __init__(
        self, folder: Path, settings: dict[str, Any], views: Sequence[TrainingView], trainer: Trainer
    ) -> None:
        parts = (
            (
                v.name,
                v.image,
                v.camera.params,
                v.cam_from_world.rotation,
                v.cam_from_world.translation,
                v.used_mask,
            )
            for v in views
        )
        self._path, self._trainer = folder / CHECKPOINT, trainer
        self._key = digest(__version__, settings, *(part for view in parts for part in view))
        self._saved = perf_counter()

    def restore(self) -> tuple[float, list[list[float]]]:
        """Restore the trainer's state, if there is any.

        Returns:
            Training time in seconds and curve so far; 0 and empty without a checkpoint.

        Raises:
            WorkspaceError: the file is damaged.
        """
        if not is_done(self._path, self._key):
            return 0.0, []
        arrays = load(self._path, {**self._trainer.table, **_OWN})
        try:
            self._trainer.restore({name: part for name, part in arrays.items() if name not in _OWN})
        except ShapeError as error:
            problem = f"{self._path} is damaged: {error}; delete it and run the command again"
            raise WorkspaceError(problem) from error
        return float(arrays["seconds"]), arrays["curve"].tolist()

    def is_due(self) -> bool:
        """Whether the last checkpoint is older than `EVERY_S`."""
        return perf_counter() - self._saved > EVERY_S

    def save(self, seconds: float, curve: list[list[float]]) -> None:
        """Write the current state.

        Raises:
            WorkspaceError: the disk is full; the previous checkpoint is kept.
        """
        counts = {"seconds": np.array(seconds), "curve": np.array(curve).reshape(-1, 4)}
        store(self._path, self._key, {**self._trainer.state(), **counts})
        self._saved = perf_counter()

    def remove(self) -> None:
        """Delete the checkpoint of a finished training."""
        self._path.unlink(missing_ok=True)
