"""Errors of an estimated trajectory: absolute, after alignment, and relative, over steps of the trajectory.

Absolute and relative errors as defined by Sturm et al. (A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012,
equations 1 to 5); KITTI's by Geiger, Lenz and Urtasun (Are we ready for autonomous driving?, CVPR 2012, section 3.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from epipole._checks import Declared, checked
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.geometry import Rigid3, Rotation3, Similarity3, align_points
from epipole.scene import Trajectory

Alignment = Literal["none", "rigid", "similarity"]
KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_STEP = 10
"""Interval, in instants, between starts of segments."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorStatistics(Declared):
    """Errors and their statistics."""

    values: Float64[np.ndarray, " n"]

    @property
    def rmse(self) -> float:
        """Root mean square error."""
        return float(np.sqrt(np.mean(self.values**2)))

    @property
    def mean(self) -> float:
        """Mean."""
        return float(self.values.mean())

    @property
    def median(self) -> float:
        """Median."""
        return float(np.median(self.values))

    @property
    def max(self) -> float:
        """Maximum."""
        return float(self.values.max())

    def __repr__(self) -> str:
        return f"ErrorStatistics({len(self.values)}, rmse {self.rmse:.4g}, median {self.median:.4g}, max {self.max:.4g})"


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryError:
    """Absolute error of a trajectory."""

    position: ErrorStatistics
    """Distances, in the truth's unit."""
    rotation_deg: ErrorStatistics
    truth_from_estimate: Similarity3
    """The alignment; identity if there is none."""

    def __repr__(self) -> str:
        return (
            f"TrajectoryError(position {self.position!r}, rotation {self.rotation_deg!r}, "
            f"scale {float(self.truth_from_estimate.scale):.6g})"
        )


@dataclass(frozen=True, slots=True, eq=False)
class DriftPerLength:
    """Mean error over segments of given lengths, per length."""

    translation_percent: float
    """Mean over all segments; NaN if the trajectory is shorter than the shortest length."""
    rotation_deg_per_m: float
    num_segments: int

    def __repr__(self) -> str:
        return (
            f"DriftPerLength({self.translation_percent:.3g} %, {100 * self.rotation_deg_per_m:.3g} deg / 100 m, "
            f"{self.num_segments} segments)"
        )


@checked
def associate(
    estimate: Trajectory, truth: Trajectory, max_difference_s: float = 0.01
) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]]:
    """Matching rows: each instant of the shorter trajectory, and the nearest in time of the other.

    If one of them has no times (`is_timed` is False), rows are matched in order.

    Raises:
        DegenerateGeometryError: no instants match, or one has no times and the lengths differ.
    """
    if not (estimate.is_timed and truth.is_timed):
        if len(estimate) != len(truth):
            raise DegenerateGeometryError(
                f"cannot match trajectories of {len(estimate)} and {len(truth)} instants: one has no times (KITTI format), and rows"
                " match in order only if the lengths are equal"
            )
        every = np.arange(len(estimate), dtype=np.int64)
        return every, every.copy()
    first, second = estimate.timestamp_s, truth.timestamp_s
    if len(first) > len(second):
        rows_of_truth, rows = associate(truth, estimate, max_difference_s)
        return rows, rows_of_truth
    after = np.clip(np.searchsorted(second, first), 1, max(len(second) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(second) - 1)
    nearest = np.where(np.abs(second[before] - first) <= np.abs(second[after] - first), before, after)
    kept = np.flatnonzero(np.abs(second[nearest] - first) <= max_difference_s)
    if not len(kept):
        raise DegenerateGeometryError(
            f"no instants of the trajectories are within {max_difference_s:g} s of each other: are the clocks the same?"
        )
    return kept.astype(np.int64), nearest[kept].astype(np.int64)


@checked
def absolute_error(estimate: Rigid3, truth: Rigid3, alignment: Alignment = "rigid") -> TrajectoryError:
    """Absolute trajectory error (ATE) of matching poses.

    Args:
        estimate: world_from_body, (n,).
        truth: poses at the same instants.
        alignment: "none", "rigid" (known scale: stereo, depth) or "similarity" (one camera).

    Raises:
        ShapeError: the batches differ.
        DegenerateGeometryError: fewer than three positions, or collinear ones, with an alignment.
    """
    moved = Similarity3(np.asarray(1.0), np.eye(3), np.zeros(3))
    if alignment != "none":
        moved = align_points(estimate.translation, truth.translation, with_scale=alignment == "similarity")
    position = np.linalg.norm(moved.apply(estimate.translation) - truth.translation, axis=1)
    rotation = Rotation3(np.swapaxes(truth.rotation, -1, -2) @ moved.rotation @ estimate.rotation)
    return TrajectoryError(
        ErrorStatistics(position), ErrorStatistics(np.degrees(rotation.angle_rad())), moved
    )


@checked
def relative_error(
    estimate: Rigid3, truth: Rigid3, step: int = 1, *, all_pairs: bool = False
) -> tuple[ErrorStatistics, ErrorStatistics]:
    """Relative pose error (RPE) over steps of the trajectory, without alignment.

    Args:
        estimate: world_from_body, (n,).
        truth: poses at the same instants.
        step: instants from the start of a step to its end.
        all_pairs: start a step at every instant, not only at the end of the previous one.

    Returns:
        Errors of translation (in the truth's unit, scale included) and of rotation in degrees.

    Raises:
        ConfigError: the step is not positive.
        DegenerateGeometryError: the trajectory is shorter than a step.
    """
    if step < 1:
        raise ConfigError(f"step must be at least 1, got {step}")
    first = np.arange(0, len(truth.translation) - step, 1 if all_pairs else step)
    if not len(first):
        raise DegenerateGeometryError(f"{len(truth.translation)} instants are too few for a step of {step}")
    error = _step_error(estimate, truth, first, first + step)
    return ErrorStatistics(np.linalg.norm(error.translation, axis=1)), ErrorStatistics(
        np.degrees(Rotation3(error.rotation).angle_rad())
    )


@checked
def drift_per_length(
    estimate: Rigid3, truth: Rigid3, lengths_m: tuple[float, ...] = KITTI_LENGTHS_M, every: int = KITTI_STEP
) -> DriftPerLength:
    """KITTI's t_rel and r_rel: error over segments of the true trajectory, divided by their length.

    Args:
        estimate: world_from_body, (n,), in meters.
        truth: poses at the same instants.
        lengths_m: lengths of the segments.
        every: instants from the start of one segment to the next.

    Raises:
        ConfigError: a length or `every` is not positive.
    """
    if every < 1 or not all(length > 0 for length in lengths_m):
        raise ConfigError("every and lengths_m must be positive")
    steps = np.linalg.norm(np.diff(truth.translation, axis=0), axis=1)
    trajectory = np.concatenate([[0.0], np.cumsum(steps)])
    first, last, length = [], [], []
    for start in range(0, len(trajectory), every):
        for wanted in lengths_m:
            end = int(np.searchsorted(trajectory, trajectory[start] + wanted, side="right"))
            if end < len(trajectory):
                first.append(start)
                last.append(end)
                length.append(wanted)
    if not first:
        return DriftPerLength(float("nan"), float("nan"), 0)
    error = _step_error(estimate, truth, np.array(first), np.array(last))
    translation = np.linalg.norm(error.translation, axis=1) / length
    rotation = Rotation3(error.rotation).angle_rad() / length
    return DriftPerLength(100.0 * float(translation.mean()), float(np.degrees(rotation.mean())), len(first))


def _step_error(estimate: Rigid3, truth: Rigid3, first: np.ndarray, last: np.ndarray) -> Rigid3:
    true_step = truth[first].inverse() @ truth[last]
    return true_step.inverse() @ (estimate[first].inverse() @ estimate[last])
