"""The trajectory of a moving body: poses over time, optionally with covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from epipole._checks import check_fields, checked
from epipole.errors import ShapeError
from epipole.geometry import Rigid3
from epipole.scene.notebook import table_html


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """One row per instant, in order of time."""

    timestamp_s: Float64[np.ndarray, " n"]
    """Seconds, from any origin; non-decreasing."""
    world_from_body: Rigid3
    covariance: Float64[np.ndarray, "n 6 6"] | None = None
    """Of xi = (translation, rotation) in the body's axes: body_from_world = exp(xi) @ the stated one."""
    is_timed: bool = True
    """False if `timestamp_s` holds row numbers 0, 1, 2, ..., for lack of times (KITTI's files)."""

    def __post_init__(self) -> None:
        """Check the rows.

        Raises:
            ShapeError: columns differ in length, times decrease, or a number is not finite.
        """
        check_fields(self)
        n, positions = len(self.timestamp_s), self.world_from_body
        if positions.batch_shape() != (n,) or (self.covariance is not None and len(self.covariance) != n):
            raise ShapeError(f"world_from_body and covariance must have {n} rows, as timestamp_s has")
        if not (np.isfinite(positions.translation).all() and np.isfinite(positions.rotation).all()):
            raise ShapeError("world_from_body must be finite: leave out instants without a pose")
        if not np.isfinite(self.timestamp_s).all() or (np.diff(self.timestamp_s) < 0).any():
            raise ShapeError("timestamp_s must be finite and never decrease")

    def __len__(self) -> int:
        return len(self.timestamp_s)

    def path_length(self) -> float:
        """Sum of the distances between consecutive positions."""
        steps = np.diff(self.world_from_body.translation, axis=0)
        return float(np.linalg.norm(steps, axis=1).sum())

    @checked
    def __getitem__(self, rows: Int64[np.ndarray, " k"]) -> Trajectory:
        """The trajectory of these rows, in their order."""
        covariance = None if self.covariance is None else self.covariance[rows]
        return Trajectory(self.timestamp_s[rows], self.world_from_body[rows], covariance, self.is_timed)

    def __repr__(self) -> str:
        if not len(self):
            return "Trajectory(0 instants)"
        seconds = float(self.timestamp_s[-1] - self.timestamp_s[0])
        known = ", with covariances" if self.covariance is not None else ""
        return f"Trajectory({len(self)} instants over {seconds:.1f} s, path {self.path_length():.3g}{known})"

    def _repr_html_(self) -> str:
        seconds = float(self.timestamp_s[-1] - self.timestamp_s[0]) if len(self) else 0.0
        rows = {"poses": len(self), "duration": f"{seconds:.1f} s", "length": f"{self.path_length():.4g}"}
        return table_html("Trajectory", rows)
