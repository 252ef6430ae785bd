"""Trajectories whose columns can be meant in several ways: the two that are compared decide together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from epipole.errors import DegenerateGeometryError, FileFormatError
from epipole.io.trajectories import NAMES_OF_UNITS, TrajectoryReading, read_as, read_trajectory_columns
from epipole.io.true_paths import truth_of_camera
from epipole.metrics import absolute_error, associate
from epipole.metrics.trajectory_scores import MIN_COMPARED
from epipole.scene import Trajectory

LEAST_COVERED = 0.5
"""Another unit of time must bring this fraction of the shorter trajectory together."""
CLEARER, MOST_DEG = 0.2, 20.0
"""Another order of the quaternion must leave so small a fraction of the rotation error, and at most so many degrees of it."""


@dataclass(slots=True, eq=False)
class Readings:
    """A trajectory as it is read at present, and what else its file allows."""

    usual: Trajectory
    assumptions: tuple[str, ...] = ()
    path: Path | None = None
    reading: TrajectoryReading | None = None
    """None where there is no other way to read it."""
    problem: FileFormatError | None = None
    """Why the file alone does not decide the order of the quaternion; None where it does."""
    is_of_camera: bool = False
    """Whether EuRoC's truth is moved to the left camera."""

    @classmethod
    def of(cls, path: Path, *, is_of_camera: bool = False) -> Readings:
        """Of a file.

        Raises:
            FileFormatError: it is no trajectory.
        """
        problem = None
        try:
            reading = read_trajectory_columns(path)
        except FileFormatError as error:
            reading = read_trajectory_columns(path, is_order_checked=False)
            problem = error
        out = cls(reading.trajectory, (), path, reading, problem, is_of_camera)
        out._take(reading)
        return out

    @classmethod
    def of_path(cls, trajectory: Trajectory, assumptions: tuple[str, ...]) -> Readings:
        """Of a path that can be meant in one way alone."""
        return cls(trajectory, assumptions)

    @property
    def is_timed(self) -> bool:
        """Whether it has times."""
        return self.usual.is_timed

    @property
    def units(self) -> list[float]:
        """Factors on its times that are possible, the present one first."""
        if self.reading is None or self.reading.columns.is_unit_certain:
            return [1.0]
        present = self.reading.columns.unit_s
        return [1.0, *(unit / present for unit in NAMES_OF_UNITS if unit != present)]

    @property
    def other_order(self) -> Readings | None:
        """With the other order of the quaternion; None where the order is certain."""
        if self.reading is None or self.path is None or self.reading.columns.is_order_certain:
            return None
        columns = self.reading.columns  # with the unit that was decided
        columns = replace(columns, format="tum" if columns.format == "euroc" else "euroc")
        out = replace(self, problem=None)
        out._take(TrajectoryReading(read_as(self.path, columns), columns))
        return out

    def _take(self, reading: TrajectoryReading) -> None:
        assert self.path is not None
        truth = truth_of_camera(self.path, reading)
        self.reading = reading
        self.usual = truth.trajectory if self.is_of_camera else reading.trajectory
        words = () if reading.columns.is_plain else (f"{self.path.name}: {reading.columns.words()}",)
        self.assumptions = truth.assumptions if self.is_of_camera else words

    @property
    def reading_unit_s(self) -> float:
        """Of the times in the file."""
        return 1.0 if self.reading is None else self.reading.columns.unit_s

    def rescale(self, factor: float) -> None:
        """Take its times to be in another unit."""
        assert self.reading is not None
        times = self.usual.timestamp_s * factor
        self.usual = replace(self.usual, timestamp_s=times)
        unit_s = min(NAMES_OF_UNITS, key=lambda unit: abs(unit - self.reading_unit_s * factor))
        columns = replace(self.reading.columns, unit_s=unit_s)
        self.reading = TrajectoryReading(self.usual, columns)


def decide_units(one: Readings, other: Readings, max_difference_s: float) -> list[str]:
    """Units of time with which instants of both belong together, where the files alone leave them open; and words about it.

    The readings are changed.
    """
    if _num_paired(one.usual, other.usual, max_difference_s) >= MIN_COMPARED:
        return []
    found = []
    for factors in list(product(one.units, other.units))[1:]:
        scaled = (
            replace(readings.usual, timestamp_s=readings.usual.timestamp_s * factor)
            for readings, factor in zip((one, other), factors)
        )
        count = _num_paired(*scaled, max_difference_s)
        if count >= max(MIN_COMPARED, LEAST_COVERED * min(len(one.usual), len(other.usual))):
            found.append(factors)
    # A common factor on both pairs the same rows: the ratio of the units is what counts.
    if len({round(first / second, 12) for first, second in found}) != 1:
        return []
    said = []
    for readings, factor in zip((one, other), found[0]):
        if factor != 1.0 and readings.path is not None:
            readings.rescale(factor)
            said.append(
                f"{readings.path.name}: times in {NAMES_OF_UNITS[readings.reading_unit_s]}, as both files together decide"
            )
    return said


def _num_paired(one: Trajectory, other: Trajectory, max_difference_s: float) -> int:
    """Instants that have one of their own in the other trajectory."""
    try:
        rows, rows_of_other = associate(one, other, max_difference_s)
    except DegenerateGeometryError:
        return 0
    return min(len(np.unique(rows)), len(np.unique(rows_of_other)))


def decide_order(one: Readings, other: Readings, max_difference_s: float) -> list[str]:
    """The order of quaternions with which the rotations of both agree, and words about it. The readings are changed.

    Both in the wrong order may agree as well as both in the right one: the usual order of a file goes before the other.

    Raises:
        FileFormatError: a file contradicts its usual order, and both together do not decide.
    """
    choices = [
        [readings] if (another := readings.other_order) is None else [readings, another]
        for readings in (one, other)
    ]
    pairs = list(product(*choices))
    errors = [_rotation_error_deg(first.usual, second.usual, max_difference_s) for first, second in pairs]
    problems = [readings.problem for readings in (one, other) if readings.problem is not None]
    agreeing = [n for n, error in enumerate(errors) if error <= MOST_DEG]
    if not problems:
        if 0 in agreeing:
            return []
        agreeing = [n for n in agreeing if errors[n] <= CLEARER * errors[0]]
    if not agreeing:
        if problems:
            raise problems[0]
        return []
    costs = [sum(_cost(readings, chosen) for readings, chosen in zip((one, other), pair)) for pair in pairs]
    best = min(agreeing, key=lambda n: (costs[n], errors[n]))
    said = []
    for readings, chosen in zip((one, other), pairs[best]):
        if chosen is not readings or readings.problem is not None:
            readings.usual, readings.reading = chosen.usual, chosen.reading
            readings.assumptions = ()
            said.append(f"{_name(readings)}: {_words(readings)}, as both files together decide")
    return said


def _cost(readings: Readings, chosen: Readings) -> int:
    """How far from usual an order is: the usual one least, unless the numbers contradict it."""
    if chosen is readings:
        return 0 if readings.problem is None else 1
    return 2 if readings.problem is None else 0


def _name(readings: Readings) -> str:
    return "" if readings.path is None else readings.path.name


def _words(readings: Readings) -> str:
    return "" if readings.reading is None else readings.reading.columns.words()


def _rotation_error_deg(one: Trajectory, other: Trajectory, max_difference_s: float) -> float:
    """Of rotations once the positions are aligned; infinite where they cannot be."""
    try:
        rows, rows_of_other = associate(one, other, max_difference_s)
        found = absolute_error(one.world_from_body[rows], other.world_from_body[rows_of_other], "similarity")
    except DegenerateGeometryError:
        return float("inf")
    return found.rotation_deg.rmse
