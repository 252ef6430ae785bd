"""Scores of a trajectory against ground truth, as in papers and other programs."""

from __future__ import annotations

from dataclasses import dataclass

from epipole._checks import checked
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3
from epipole.metrics.trajectories import (
    Alignment,
    absolute_error,
    associate,
    drift_per_length,
    relative_error,
)
from epipole.scene import Trajectory

MIN_COMPARED = 3
"""Minimum number of instants for an alignment."""


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryScore:
    """Scores of a trajectory with one kind of alignment."""

    ate_rmse: float
    """Absolute trajectory error, in the truth's unit."""
    ate_median: float
    ate_max: float
    rotation_rmse_deg: float
    scale: float
    """Of truth over estimate, as aligned."""
    step_rmse: float
    """Relative error (RPE) of translation between consecutive instants, with this scale."""
    kitti_percent: float | None
    """KITTI's t_rel, with this scale; None if the trajectory is shorter than 100."""


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryEvaluation:
    """Evaluation of a trajectory against ground truth."""

    num_instants: int
    num_truth: int
    num_compared: int
    path_length: float
    """Of the truth over the compared instants, in its unit."""
    rigid: TrajectoryScore
    """With rotation and translation aligned, SE(3): for estimates with known scale."""
    similarity: TrajectoryScore
    """With scale aligned, too, Sim(3): for a single camera."""
    step_rotation_rmse_deg: float
    kitti_deg_per_100m: float | None
    """KITTI's r_rel; None if the trajectory is shorter than 100."""
    assumptions: tuple[str, ...] = ()
    """Assumptions about how to read and match the files, in words."""

    @property
    def coverage(self) -> float:
        """Fraction of the instants of the shorter trajectory that were compared."""
        return self.num_compared / min(self.num_instants, self.num_truth)

    def __repr__(self) -> str:
        return (
            f"TrajectoryEvaluation({self.num_compared} of {self.num_instants} instants, ATE rmse "
            f"{self.rigid.ate_rmse:.4g} rigidly, {self.similarity.ate_rmse:.4g} with scale)"
        )


@checked
def score_trajectory(
    estimate: Trajectory, truth: Trajectory, max_difference_s: float = 0.01
) -> TrajectoryEvaluation:
    """Evaluate a trajectory against ground truth.

    Args:
        estimate: in any world, at any scale.
        truth: of the same body.
        max_difference_s: largest time difference of matching instants.

    Raises:
        DegenerateGeometryError: too few instants match, or the trajectory is a line.
    """
    rows, rows_of_truth = associate(estimate, truth, max_difference_s)
    if len(rows) < MIN_COMPARED:
        raise DegenerateGeometryError(
            f"{len(rows)} of {len(estimate)} instants match one of the truth within {max_difference_s:g} s,"
            f" {MIN_COMPARED} are needed: are the clocks and their units the same?"
        )
    ours, theirs = estimate.world_from_body[rows], truth.world_from_body[rows_of_truth]
    _, rotation = relative_error(ours, theirs)
    drift = drift_per_length(ours, theirs)
    return TrajectoryEvaluation(
        len(estimate),
        len(truth),
        len(rows),
        truth[rows_of_truth].path_length(),
        _score(ours, theirs, "rigid"),
        _score(ours, theirs, "similarity"),
        rotation.rmse,
        100.0 * drift.rotation_deg_per_m if drift.num_segments else None,
    )


def _score(ours: Rigid3, theirs: Rigid3, alignment: Alignment) -> TrajectoryScore:
    found = absolute_error(ours, theirs, alignment)
    scale = float(found.truth_from_estimate.scale)
    scaled = Rigid3(ours.rotation, scale * ours.translation)
    step, _ = relative_error(scaled, theirs)
    drift = drift_per_length(scaled, theirs)
    position = found.position
    return TrajectoryScore(
        position.rmse,
        position.median,
        position.max,
        found.rotation_deg.rmse,
        scale,
        step.rmse,
        drift.translation_percent if drift.num_segments else None,
    )
