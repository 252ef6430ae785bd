"""Meaning of the columns in a trajectory file, from the names in its header or else from the numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from epipole.errors import FileFormatError
from epipole.io._time_units import unit_of_clock
from epipole.io.files import file_text

TrajectoryFormat = Literal["tum", "kitti", "euroc"]
TUM, TUM_WITH_COVARIANCE, KITTI = 8, 29, 12
NS, SECONDS = 1e-9, 1.0
NAMES_OF_UNITS = {1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds", NS: "nanoseconds"}
_QUATERNION = re.compile(r"^q(?:uat(?:ernion)?)?(?:_?\w*)?[_.]?([wxyz])$", re.IGNORECASE)
_UNIT_WORDS = ((re.compile(r"[\[(]\s*ns\s*[\])]"), NS), (re.compile(r"[\[(]\s*s(?:ec)?\s*[\])]"), SECONDS))
_LEAST_STEP_NS = 1e5
"""Integers with at least this spacing are nanoseconds: in seconds, poses would be a day apart."""
_NORM_TOLERANCE = 1e-2
_NEAR_ONE, _NEAR_ZERO = 0.95, 0.3


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryTable:
    """The numbers in a file and the text that describes them."""

    path: Path
    rows: list[tuple[int, list[str]]]
    """Line number and words of each non-empty line."""
    header: str
    """The last comment before the first row."""
    has_commas: bool

    @property
    def num_columns(self) -> int:
        """Number of columns in the first row."""
        return len(self.rows[0][1])


@dataclass(frozen=True, slots=True)
class Columns:
    """An interpretation of the columns."""

    format: TrajectoryFormat
    """tum: quaternion with w last; euroc: w first; kitti: matrices without times."""
    unit_s: float
    """Unit of the times, in seconds."""
    is_order_certain: bool
    is_unit_certain: bool

    @property
    def is_plain(self) -> bool:
        """Whether no assumption needs reporting: TUM with seconds, KITTI matrices, or columns named in the header."""
        return (
            self.format == "kitti"
            or self.is_order_certain
            or (self.format == "tum" and self.unit_s == SECONDS)
        )

    def words(self) -> str:
        """Description of the assumed quaternion order and time unit."""
        if self.format == "kitti":
            return "matrices without times (KITTI)"
        order = "w last (TUM)" if self.format == "tum" else "w first (EuRoC)"
        return f"quaternion with {order}, times in {NAMES_OF_UNITS[self.unit_s]}"


def read_table(path: Path) -> TrajectoryTable:
    """Split the non-empty lines of a file into words.

    Raises:
        FileFormatError: the file is missing, or has no such lines.
    """
    rows: list[tuple[int, list[str]]] = []
    header, has_commas = "", False
    for number, line in enumerate(file_text(path).splitlines(), 1):
        words = line.replace(",", " ").split()
        if words and words[0].startswith("#"):
            header = header if rows else line
        elif words:
            has_commas = has_commas or "," in line
            rows.append((number, words))
    if not rows:
        raise FileFormatError(path, "it contains no poses")
    return TrajectoryTable(path, rows, header, has_commas)


def format_by_width(table: TrajectoryTable) -> bool:
    """Whether the rows are KITTI matrices; otherwise they start with a time, a position and a quaternion.

    Raises:
        FileFormatError: the number of columns is not supported.
    """
    count, number = table.num_columns, table.rows[0][0]
    if count == KITTI:
        return True
    if count in (TUM, TUM_WITH_COVARIANCE) or (count > TUM and (table.has_commas or _order_of_header(table))):
        return False
    raise FileFormatError(
        table.path,
        f"line {number}: {count} columns do not match a trajectory (TUM has 8 or 29, KITTI 12, EuRoC CSV at least 8)",
    )


def choose_columns(table: TrajectoryTable, values: np.ndarray) -> Columns:
    """The most likely meaning of the columns of timed rows; `is_order_certain` is False if another one is possible."""
    unit_s, is_unit_certain = _unit(table, values[:, 0])
    named = _order_of_header(table)
    if named is not None or table.num_columns == TUM_WITH_COVARIANCE:
        return Columns(named or "tum", unit_s, True, is_unit_certain)
    is_euroc = table.has_commas and unit_s != SECONDS
    usual: TrajectoryFormat = "euroc" if is_euroc else "tum"
    return Columns(usual, unit_s, False, is_unit_certain)


def check_order(table: TrajectoryTable, values: np.ndarray, columns: Columns) -> None:
    """Check that the numbers in a file without column names do not contradict the usual quaternion order.

    The norm is the same for both orders, but most trajectories start near the identity rotation, where w is close to 1.

    Raises:
        FileFormatError: they contradict it, so the order cannot be determined from this file.
    """
    if columns.is_order_certain or not table.has_commas:
        return
    first = np.abs(values[0, 4:8])
    starts_with_w, ends_with_w = (
        first[one] > _NEAR_ONE and first[other] < _NEAR_ZERO for one, other in ((0, 3), (3, 0))
    )
    is_usual_form = (
        columns.format == "euroc"
    )  # EuRoC uses commas and nanoseconds; no format uses commas and seconds
    agrees, contradicts = (
        (ends_with_w, starts_with_w) if columns.format == "tum" else (starts_with_w, ends_with_w)
    )
    if contradicts or not (agrees or is_usual_form):
        raise FileFormatError(
            table.path,
            f"Unknown quaternion order: commas and times in {NAMES_OF_UNITS[columns.unit_s]} suggest "
            f"{columns.words().split(',')[0]}, but the numbers in line {table.rows[0][0]} do not. Start the file with "
            "a line that names the columns, such as '# timestamp x y z qx qy qz qw'",
        )


def check_position_of_quaternion(table: TrajectoryTable, values: np.ndarray) -> None:
    """Check that the quaternion follows the position.

    Raises:
        FileFormatError: it precedes the position.
    """
    has_own = np.abs(np.linalg.norm(values[:, 4:8], axis=1) - 1.0) <= _NORM_TOLERANCE
    has_early = np.abs(np.linalg.norm(values[:, 1:5], axis=1) - 1.0) <= _NORM_TOLERANCE
    if not has_own.all() and has_early.all() and len(values) > 1:
        raise FileFormatError(
            table.path,
            "columns 2 to 5 are unit quaternions, but the position must come before the quaternion (t x y z qx qy qz qw)",
        )


def _unit(table: TrajectoryTable, times: np.ndarray) -> tuple[float, bool]:
    clock = unit_of_clock(times)
    if clock is not None:
        return clock[0], True
    said = next((factor for words, factor in _UNIT_WORDS if words.search(table.header.split("x")[0])), None)
    are_whole = bool((times == np.rint(times)).all())
    steps = np.diff(times)
    if said is not None and (said == SECONDS or are_whole):
        return said, True
    if not are_whole:
        return SECONDS, True
    is_counted = not any("." in words[0] for _, words in table.rows)
    if is_counted and len(steps) and float(np.median(steps)) >= _LEAST_STEP_NS:
        return NS, False
    # Integers close to each other may be seconds, image numbers, or times in any unit.
    return SECONDS, False


def _order_of_header(table: TrajectoryTable) -> TrajectoryFormat | None:
    """The quaternion order given by the column names; None if they are not named."""
    names = re.sub(r"[\[(][^\])]*[\])]", " ", table.header.lstrip("# ")).replace(",", " ").split()
    letters = "".join(match[1].lower() for name in names if (match := _QUATERNION.match(name)))
    if letters == "wxyz":
        return "euroc"
    return "tum" if letters == "xyzw" else None
