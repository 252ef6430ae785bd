"""A trajectory against a known one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from epipole._checks import as_path
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.io.trajectories import read_trajectory
from epipole.metrics import Alignment, absolute_error, associate, drift_per_length, relative_error

TRAJECTORIES = ("trajectory.txt", "trajectory_causal.txt")
"""Of an output folder: the final one, and what was known when each frame came."""


def trajectories_of(out: Path, truth: Path) -> list[Path]:
    """The trajectories to compare with a truth; empty where the truth is one of pictures.

    Raises:
        FileFormatError: the truth is a trajectory, and there is none to compare with it.
    """
    if not truth.is_file() or truth.suffix.lower() == ".json" or truth.name.endswith("_par.txt"):
        return []
    if out.is_file():
        return [out]
    found = [out / name for name in TRAJECTORIES if (out / name).is_file()]
    if not found:
        raise FileFormatError(out, f"is no trajectory, and holds no {TRAJECTORIES[0]}")
    return found


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryScore:
    """How far a trajectory is from a known one, with one kind of alignment."""

    ate_rmse: float
    """In the truth's unit."""
    ate_median: float
    ate_max: float
    rotation_rmse_deg: float
    scale: float
    """Of truth over estimate, as aligned."""


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryEvaluation:
    """A trajectory against a known one."""

    num_instants: int
    num_truth: int
    num_compared: int
    path_length: float
    """Of the truth over the instants compared, in its unit."""
    rigid: TrajectoryScore
    """With rotation and translation aligned: what counts where the scale is known."""
    similarity: TrajectoryScore
    """With scale aligned, too: what one camera alone can be asked for."""
    step_rmse: float
    """Relative error of translation from one compared instant to the next."""
    step_rotation_rmse_deg: float
    kitti_percent: float | None
    """KITTI's t_rel; None for a path of less than 100."""
    kitti_deg_per_100m: float | None


def evaluate_trajectory(
    estimate: str | Path, truth: str | Path, max_difference_s: float = 0.01
) -> TrajectoryEvaluation:
    """Compare a trajectory with a known one; instants without times (KITTI) belong together in their order.

    Args:
        estimate: TUM, KITTI or EuRoC file.
        truth: another.
        max_difference_s: instants further apart are not compared.

    Raises:
        FileFormatError: one of them cannot be read, or one has times and the other none.
        DegenerateGeometryError: too few instants belong together, or the path is a line.
    """
    found, known = read_trajectory(as_path(estimate)), read_trajectory(as_path(truth))
    rows, rows_of_truth = associate(found, known, max_difference_s)
    ours, theirs = found.world_from_body[rows], known.world_from_body[rows_of_truth]
    step, turn = relative_error(ours, theirs)
    drift = drift_per_length(ours, theirs)
    has_drift = drift.num_segments > 0
    return TrajectoryEvaluation(
        *(len(found), len(known), len(rows), known[rows_of_truth].path_length()),
        *(_score(ours, theirs, "rigid"), _score(ours, theirs, "similarity")),
        *(step.rmse, turn.rmse),
        drift.translation_percent if has_drift else None,
        100.0 * drift.rotation_deg_per_m if has_drift else None,
    )


def _score(ours: Rigid3, theirs: Rigid3, alignment: Alignment) -> TrajectoryScore:
    found = absolute_error(ours, theirs, alignment)
    position = found.position
    return TrajectoryScore(
        *(position.rmse, position.median, position.max, found.rotation_deg.rmse),
        float(found.truth_from_estimate.scale),
    )
