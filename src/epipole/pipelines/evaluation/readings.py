"""Trajectories with ambiguous columns: resolved by comparing the two files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from epipole.errors import DegenerateGeometryError, FileFormatError
from epipole.geometry import Rotation3
from epipole.io.trajectories.files import NAMES_OF_UNITS, TrajectoryReading, read_as, read_trajectory_columns
from epipole.io.trajectories.true_trajectories import truth_of_camera
from epipole.metrics import absolute_error, associate
from epipole.metrics.trajectory_scores import MIN_COMPARED
from epipole.scene import Trajectory

LEAST_COVERED = 0.5
"""Another time unit must match at least this fraction of the shorter trajectory."""
CLEARER, MOST_DEG = 0.2, 20.0
"""Another quaternion order must reduce the rotation error to this fraction, and to this many degrees."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """A trajectory as currently interpreted, and the alternatives that its file allows."""

    trajectory: Trajectory
    assumptions: tuple[str, ...] = ()
    path: Path | None = None
    """None if there is no other interpretation."""
    columns_of: TrajectoryReading | None = None
    problem: FileFormatError | None = None
    """Why the file alone does not determine the quaternion order; None if it does."""
    is_of_camera: bool = False
    """Whether EuRoC's ground truth is converted to the left camera."""

    @property
    def units_s(self) -> list[float]:
        """Possible units of the file's times in seconds, the current one first."""
        columns = None if self.columns_of is None else self.columns_of.columns
        if columns is None or columns.is_unit_certain:
            return [1.0 if columns is None else columns.unit_s]
        return [columns.unit_s, *(unit for unit in NAMES_OF_UNITS if unit != columns.unit_s)]

    @property
    def name(self) -> str:
        """Name of the file."""
        return "" if self.path is None else self.path.name

    def words(self) -> str:
        """How the columns are interpreted."""
        return "" if self.columns_of is None else self.columns_of.columns.words()


def read_file(path: Path, *, is_of_camera: bool = False) -> Reading:
    """Read a trajectory; if its numbers contradict the usual order, the result has a problem.

    Raises:
        FileFormatError: the file is not a trajectory.
    """
    try:
        found, problem = read_trajectory_columns(path), None
    except FileFormatError as error:
        found, problem = read_trajectory_columns(path, is_order_checked=False), error
    return _taken(Reading(found.trajectory, (), path, found, problem, is_of_camera), found)


def _taken(before: Reading, found: TrajectoryReading) -> Reading:
    assert before.path is not None
    if before.is_of_camera:
        truth = truth_of_camera(before.path, found)
        return replace(before, trajectory=truth.trajectory, assumptions=truth.assumptions, columns_of=found)
    words = () if found.columns.is_plain else (f"{before.name}: {found.columns.words()}",)
    return replace(before, trajectory=found.trajectory, assumptions=words, columns_of=found)


def with_unit(reading: Reading, unit_s: float) -> Reading:
    """The same trajectory with its times in this unit."""
    found = reading.columns_of
    if found is None or found.columns.unit_s == unit_s:
        return reading
    times = reading.trajectory.timestamp_s * (unit_s / found.columns.unit_s)
    trajectory = replace(reading.trajectory, timestamp_s=times)
    columns = replace(found.columns, unit_s=unit_s)
    return replace(reading, trajectory=trajectory, columns_of=TrajectoryReading(trajectory, columns))


def with_other_order(reading: Reading) -> Reading | None:
    """The same trajectory with the other quaternion order; None if the order is certain."""
    found = reading.columns_of
    if found is None or reading.path is None or found.columns.is_order_certain:
        return None
    columns = replace(found.columns, format="tum" if found.columns.format == "euroc" else "euroc")
    again = TrajectoryReading(read_as(reading.path, columns), columns)
    return _taken(replace(reading, problem=None), again)


def decide_units(one: Reading, other: Reading, max_difference_s: float) -> tuple[Reading, Reading]:
    """Both trajectories with the time units that make their poses match, if the files alone leave the units open."""
    if _num_paired(one.trajectory, other.trajectory, max_difference_s) >= MIN_COMPARED:
        return one, other
    least = max(MIN_COMPARED, LEAST_COVERED * min(len(one.trajectory), len(other.trajectory)))
    found = []
    for units_s in list(product(one.units_s, other.units_s))[1:]:
        first, second = (with_unit(reading, unit_s) for reading, unit_s in zip((one, other), units_s))
        if _num_paired(first.trajectory, second.trajectory, max_difference_s) >= least:
            found.append(units_s)
    # The same factor on both matches the same rows: only the ratio of the units counts.
    if len({round(float(np.log10(first / second))) for first, second in found}) != 1:
        return one, other
    out = []
    for reading, unit_s in zip((one, other), found[0]):
        changed = with_unit(reading, unit_s)
        if changed is not reading:
            words = f"{reading.name}: times in {NAMES_OF_UNITS[unit_s]}, determined from both files"
            changed = replace(changed, assumptions=(*changed.assumptions, words))
        out.append(changed)
    return out[0], out[1]


def _num_paired(one: Trajectory, other: Trajectory, max_difference_s: float) -> int:
    try:
        rows, rows_of_other = associate(one, other, max_difference_s)
    except DegenerateGeometryError:
        return 0
    return min(len(np.unique(rows)), len(np.unique(rows_of_other)))


def decide_order(one: Reading, other: Reading, max_difference_s: float) -> tuple[Reading, Reading]:
    """Both trajectories with the quaternion orders that make their rotations agree.

    Two wrong orders may agree as well as two right ones, so a file's usual order is preferred.

    Raises:
        FileFormatError: a file contradicts its usual order, and the two files together are ambiguous.
    """
    choices = [
        [reading] if (another := with_other_order(reading)) is None else [reading, another]
        for reading in (one, other)
    ]
    pairs = [(first, second) for first, second in product(*choices)]
    both = [_rotation_errors_deg(first, second, max_difference_s) for first, second in pairs]
    errors, since_first = [pair[0] for pair in both], [pair[1] for pair in both]
    problems = [reading.problem for reading in (one, other) if reading.problem is not None]
    agreeing = [n for n, error in enumerate(errors) if error <= MOST_DEG]
    if not problems and 0 not in agreeing:
        # Positions on a line, or at rest, leave the alignment's rotation free; rotations since the first pose do not need it.
        agreeing = [
            n for n in agreeing if errors[n] <= CLEARER * errors[0] and since_first[n] <= since_first[0]
        ]
    if not agreeing and problems:
        raise problems[0]
    if not agreeing or (0 in agreeing and not problems):
        return one, other
    costs = [sum(_cost(reading, chosen) for reading, chosen in zip((one, other), pair)) for pair in pairs]
    best = pairs[min(agreeing, key=lambda n: (costs[n], errors[n]))]
    return _decided(one, best[0]), _decided(other, best[1])


def _decided(reading: Reading, chosen: Reading) -> Reading:
    """Record the order as an assumption if both files determined it."""
    if chosen is reading and reading.problem is None:
        return reading
    words = f"{chosen.name}: {chosen.words()}, determined from both files"
    return replace(chosen, assumptions=(words,), problem=None)


def _cost(reading: Reading, chosen: Reading) -> int:
    """Cost of an order: the usual one is cheapest, unless the numbers contradict it."""
    if chosen is reading:
        return 0 if reading.problem is None else 1
    return 2 if reading.problem is None else 0


def _rotation_errors_deg(one: Reading, other: Reading, max_difference_s: float) -> tuple[float, float]:
    """RMSE of rotations after alignment of positions, and relative to the first pose; infinite without an alignment."""
    first, second = one.trajectory, other.trajectory
    try:
        rows, rows_of_other = associate(first, second, max_difference_s)
        ours, theirs = first.world_from_body[rows], second.world_from_body[rows_of_other]
        found = absolute_error(ours, theirs, "similarity")
    except DegenerateGeometryError:
        return float("inf"), float("inf")
    since = [positions.rotation[0].T @ positions.rotation for positions in (ours, theirs)]
    apart = Rotation3(np.swapaxes(since[0], 1, 2) @ since[1]).angle_rad()
    return found.rotation_deg.rmse, float(np.degrees(np.sqrt(np.mean(apart**2))))
