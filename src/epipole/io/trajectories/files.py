"""Reading and writing trajectories in TUM, KITTI and EuRoC formats."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io._time_units import seconds_of
from epipole.io.atomic import atomic_write
from epipole.io.trajectories._columns import (
    KITTI,
    NS,
    SECONDS,
    TUM,
    TUM_WITH_COVARIANCE,
    Columns,
    TrajectoryTable,
    check_order,
    check_position_of_quaternion,
    choose_columns,
    format_by_width,
    read_table,
)
from epipole.io.trajectories._columns import NAMES_OF_UNITS as NAMES_OF_UNITS
from epipole.io.trajectories._columns import TrajectoryFormat as TrajectoryFormat
from epipole.scene import Trajectory

_ROTATION_TOLERANCE = 1e-2
_UPPER = np.triu_indices(6)
_COVARIANCE_WORDS = (
    ", and the upper triangle, row by row, of the covariance of xi = (translation in meters or the trajectory's unit, rotation in radians) "
    "in body_from_world = exp(xi) @ stored pose"
)


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryReading:
    """A trajectory and how the columns of its file were interpreted."""

    trajectory: Trajectory
    columns: Columns


@checked
def trajectory_format(path: str | Path) -> TrajectoryFormat:
    """The format of a trajectory file by its content: tum (quaternion with w last), euroc (w first), kitti (no times).

    Raises:
        FileFormatError: the file is missing, in another format, or its columns are ambiguous.
    """
    return read_trajectory_columns(path).columns.format


@checked
def read_trajectory(path: str | Path, format: TrajectoryFormat | None = None) -> Trajectory:
    """Read a trajectory.

    TUM: `t x y z qx qy qz qw` per line, then 21 numbers if the covariance is known (its upper triangle, row by row).
    KITTI: the 12 numbers of the 3 x 4 matrix world_from_body per line; times are 0, 1, 2, ... and `is_timed` is False.
    EuRoC: time, position, quaternion (w first), and further columns, which are ignored. Numbers are separated by spaces
    or commas, and lines that start with # are skipped. Column names in the header determine the quaternion order;
    otherwise commas with nanoseconds mean EuRoC, and spaces TUM. The file's suffix is ignored. Times since 1970 in
    nanoseconds, microseconds or milliseconds are recognized by their size.

    Args:
        path: the file.
        format: None: determined from the content.

    Raises:
        FileFormatError: the file is missing or empty, a line is malformed, times decrease, or the columns are
            ambiguous.
    """
    return read_trajectory_columns(path, format).trajectory


def read_trajectory_columns(
    path: str | Path, format: TrajectoryFormat | None = None, *, is_order_checked: bool = True
) -> TrajectoryReading:
    """Read a trajectory and report how its columns were interpreted.

    Args:
        path: the file.
        format: None: determined from the content.
        is_order_checked: reject a file whose quaternion order is ambiguous.

    Raises:
        FileFormatError: as in `read_trajectory`.
    """
    table = read_table(Path(path))
    if format == "kitti" or (format is None and format_by_width(table)):
        return _reading(table, _numbers(table.path, table.rows, KITTI), Columns("kitti", SECONDS, True, True))
    values = _numbers(table.path, table.rows, TUM)
    columns = choose_columns(table, values)
    if format is None:
        check_position_of_quaternion(table, values)
        if is_order_checked:
            check_order(table, values, columns)
    else:
        columns = replace(columns, format=format, is_order_certain=True)
    return _reading(table, values, columns)


def read_as(path: str | Path, columns: Columns) -> Trajectory:
    """Read a trajectory with a given interpretation of its columns.

    Raises:
        FileFormatError: as in `read_trajectory`.
    """
    table = read_table(Path(path))
    return _reading(table, _numbers(table.path, table.rows, TUM), columns).trajectory


def _reading(table: TrajectoryTable, values: np.ndarray, columns: Columns) -> TrajectoryReading:
    path, rows = table.path, table.rows
    covariance = None
    if columns.format == "kitti":
        times, translation = np.arange(len(values), dtype=np.float64), values[:, 3:12:4]
        rotation = values[:, :12].reshape(-1, 3, 4)[:, :, :3]
        nearest = Rotation3.nearest(rotation).matrix
        wrong = np.abs(nearest - rotation).max(axis=(1, 2)) > _ROTATION_TOLERANCE
        _refuse(path, rows, wrong, "not a rotation matrix")
    else:
        times, translation = values[:, 0] * columns.unit_s, values[:, 1:4]
        order = [4, 5, 6, 7] if columns.format == "euroc" else [7, 4, 5, 6]
        norm = np.linalg.norm(values[:, order], axis=1)
        _refuse(path, rows, np.abs(norm - 1.0) > _ROTATION_TOLERANCE, "not a unit quaternion")
        nearest = Rotation3.from_quat_wxyz(values[:, order] / norm[:, None]).matrix
        if columns.format == "tum" and values.shape[1] == TUM_WITH_COVARIANCE:
            covariance = np.zeros((len(values), 6, 6))
            covariance[:, *_UPPER] = covariance[:, *_UPPER[::-1]] = values[:, TUM:]
    _refuse(
        path, rows, np.diff(times, prepend=-np.inf) < 0, "its time is earlier than that of the previous line"
    )
    positions = Rigid3(nearest, np.ascontiguousarray(translation))
    is_timed = columns.format != "kitti"
    return TrajectoryReading(Trajectory(times, positions, covariance, is_timed), columns)


@checked
def read_pose_matrix(path: str | Path) -> Rigid3:
    """Read a pose from a 3 x 4 or 4 x 4 matrix, one row per line (7-Scenes' `frame-*.pose.txt`, world_from_cam).

    Raises:
        FileFormatError: the file is missing, or is not such a matrix.
    """
    path = Path(path)
    values = _numbers(path, read_table(path).rows, 4)
    if values.shape not in ((3, 4), (4, 4)):
        raise FileFormatError(path, f"expected a matrix with 3 or 4 rows and 4 columns, got {values.shape}")
    rotation = np.ascontiguousarray(values[:3, :3])
    nearest = Rotation3.nearest(rotation).matrix
    if not np.abs(nearest - rotation).max() <= _ROTATION_TOLERANCE:
        raise FileFormatError(path, "its first three columns are not a rotation matrix")
    return Rigid3(nearest, np.ascontiguousarray(values[:3, 3]))


@dataclass(frozen=True, slots=True, eq=False)
class PositionLog:
    """Measured positions over time."""

    timestamp_s: Float64[np.ndarray, " n"]
    """Strictly increasing."""
    positions: Float64[np.ndarray, "n 3"]


@checked
def read_positions(path: str | Path) -> PositionLog:
    """Read a log of positions: `seconds x y z` per line, separated by spaces or commas; further columns are ignored.

    Times since 1970 in nanoseconds, microseconds or milliseconds are recognized by their size.

    Raises:
        FileFormatError: the file is missing or empty, a line has fewer than four numbers, or times do not increase.
    """
    path = Path(path)
    rows = [(number, words[:4]) for number, words in read_table(path).rows]
    values = _numbers(path, rows, 4)
    _refuse(
        path,
        rows,
        np.diff(values[:, 0], prepend=-np.inf) <= 0,
        "its time is not later than that of the previous line",
    )
    return PositionLog(seconds_of(values[:, 0])[0].copy(), values[:, 1:4].copy())


@checked
def write_trajectory(
    trajectory: Trajectory,
    path: str | Path,
    format: TrajectoryFormat = "tum",
    *,
    with_covariance: bool = False,
) -> None:
    """Write a trajectory.

    Args:
        trajectory: poses and times.
        path: the file, replaced atomically.
        format: tum, kitti (without times) or euroc.
        with_covariance: write TUM's 29 columns.

    Raises:
        ConfigError: the covariance is unknown, or the format cannot store it.
        WorkspaceError: the file cannot be written.
    """
    positions = trajectory.world_from_body
    if with_covariance and (format != "tum" or trajectory.covariance is None):
        raise ConfigError("writing covariances needs the format 'tum' and a trajectory with covariances")
    with atomic_write(path) as aside, aside.open("w", encoding="utf-8") as file:
        if format == "kitti":
            matrices = np.concatenate([positions.rotation, positions.translation[:, :, None]], axis=2)
            file.writelines(f"{exact_text(row)}\n" for row in matrices.reshape(-1, 12))
            return
        wxyz = Rotation3(positions.rotation).as_quat_wxyz()
        if format == "euroc":
            file.write("#timestamp [ns],x [m],y [m],z [m],qw [],qx [],qy [],qz []\n")
            for t, p, q in zip(trajectory.timestamp_s, positions.translation, wxyz):
                file.write(f"{round(t / NS)},{exact_text([*p, *q], ',')}\n")
            return
        file.write("# timestamp tx ty tz qx qy qz qw" + (_COVARIANCE_WORDS if with_covariance else "") + "\n")
        for n, (t, p, q) in enumerate(zip(trajectory.timestamp_s, positions.translation, wxyz)):
            values = [*p, *q[[1, 2, 3, 0]]]
            if with_covariance and trajectory.covariance is not None:
                values += [*trajectory.covariance[n][_UPPER]]
            file.write(f"{t:.9f} {exact_text(values)}\n")


def exact_text(values: Iterable[float], separator: str = " ") -> str:
    """Numbers with enough digits to read back exactly: in UTM coordinates, nine digits would round to centimeters."""
    return separator.join(repr(float(value)) for value in values)


def _numbers(path: Path, rows: list[tuple[int, list[str]]], at_least: int) -> np.ndarray:
    count = len(rows[0][1])
    out = np.empty((len(rows), count))
    for n, (number, words) in enumerate(rows):
        if len(words) != count or count < at_least:
            raise FileFormatError(
                path, f"line {number}: got {len(words)} columns, expected {max(count, at_least)}"
            )
        try:
            out[n] = words
        except ValueError as error:
            raise FileFormatError(path, f"line {number}: {error}") from error
    # A variance may be infinite, if nothing is known about a pose.
    wrong = np.asarray(~np.isfinite(out[:, :at_least]).all(axis=1) | np.isnan(out).any(axis=1))
    _refuse(path, rows, wrong, "a number is not finite")
    return out


def _refuse(path: Path, rows: list[tuple[int, list[str]]], wrong: np.ndarray, why: str) -> None:
    if wrong.any():
        raise FileFormatError(path, f"line {rows[int(np.argmax(wrong))][0]}: {why}")
