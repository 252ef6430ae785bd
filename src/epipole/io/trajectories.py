"""Trajectories as TUM, KITTI and EuRoC write them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64

from epipole._declared import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.atomic import atomic_write
from epipole.io.files import file_text
from epipole.scene import Trajectory

TrajectoryFormat = Literal["tum", "kitti", "euroc"]
_ROTATION_TOLERANCE = 1e-2
_UPPER = np.triu_indices(6)
_COVARIANCE_WORDS = (
    ", and the upper triangle, row by row, of the covariance of xi = (translation in metres or the path's unit, rotation in radians) "
    "in body_from_world = exp(xi) @ what is stated"
)
_TUM, _TUM_WITH_COVARIANCE, _KITTI, _EUROC = 8, 29, 12, 8
_NS = 1e-9


@checked
def trajectory_format(path: str | Path) -> TrajectoryFormat:
    """The form of a trajectory's file, seen from its first line; KITTI's is the one without times.

    Raises:
        FileFormatError: no such file, or one of another kind.
    """
    path = Path(path)
    return _format_of(path, _rows(path)[0])


@checked
def read_trajectory(path: str | Path, format: TrajectoryFormat | None = None) -> Trajectory:
    """Read a trajectory.

    TUM: `t x y z qx qy qz qw` a line, and 21 numbers more where the covariance is known (its upper triangle, row by row).
    KITTI: the 12 numbers of the 3 x 4 matrix world_from_body a line; instants are 0, 1, 2, ... EuRoC: CSV of
    nanoseconds, position, quaternion (w first), and more columns that are not read. Lines that start with # are skipped.

    Args:
        path: the file.
        format: None: seen from the file.

    Raises:
        FileFormatError: no such file, a line that is none, times that fall, or no instant at all.
    """
    path = Path(path)
    rows = _rows(path)
    kind = _format_of(path, rows[0]) if format is None else format
    values = _numbers(path, rows, {"tum": _TUM, "kitti": _KITTI, "euroc": _EUROC}[kind])
    covariance = None
    if kind == "kitti":
        times, translation = np.arange(len(values), dtype=np.float64), values[:, 3::4]
        rotation = values.reshape(-1, 3, 4)[:, :, :3]
        nearest = Rotation3.nearest(rotation).matrix
        _refuse(
            path,
            rows,
            np.abs(nearest - rotation).max(axis=(1, 2)) > _ROTATION_TOLERANCE,
            "no rotation matrix",
        )
    else:
        times, translation = values[:, 0] * (_NS if kind == "euroc" else 1.0), values[:, 1:4]
        order = [4, 5, 6, 7] if kind == "euroc" else [7, 4, 5, 6]
        norm = np.linalg.norm(values[:, order], axis=1)
        _refuse(path, rows, np.abs(norm - 1.0) > _ROTATION_TOLERANCE, "no unit quaternion")
        nearest = Rotation3.from_quat_wxyz(values[:, order] / norm[:, None]).matrix
        if kind == "tum" and values.shape[1] == _TUM_WITH_COVARIANCE:
            covariance = np.zeros((len(values), 6, 6))
            covariance[:, *_UPPER] = covariance[:, *_UPPER[::-1]] = values[:, _TUM:]
    _refuse(path, rows, np.diff(times, prepend=-np.inf) < 0, "its time is before that of the line above")
    return Trajectory(times, Rigid3(nearest, np.ascontiguousarray(translation)), covariance)


@checked
def read_pose_matrix(path: str | Path) -> Rigid3:
    """A place from the 3 x 4 or 4 x 4 matrix in a file, a row a line (7-Scenes' `frame-*.pose.txt`, world_from_cam).

    Raises:
        FileFormatError: no such file, or no such matrix.
    """
    path = Path(path)
    values = _numbers(path, _rows(path), 4)
    if values.shape not in ((3, 4), (4, 4)):
        raise FileFormatError(path, f"a matrix of 3 or 4 rows and 4 columns expected, got {values.shape}")
    rotation = np.ascontiguousarray(values[:3, :3])
    nearest = Rotation3.nearest(rotation).matrix
    if not np.abs(nearest - rotation).max() <= _ROTATION_TOLERANCE:
        raise FileFormatError(path, "its first three columns are no rotation matrix")
    return Rigid3(nearest, np.ascontiguousarray(values[:3, 3]))


@dataclass(frozen=True, slots=True, eq=False)
class PositionLog:
    """Measured places."""

    timestamp_s: Float64[np.ndarray, " n"]
    """Rising."""
    positions: Float64[np.ndarray, "n 3"]


@checked
def read_positions(path: str | Path) -> PositionLog:
    """Read a log of places: `seconds x y z` a line, by spaces or commas, and whatever else follows (TUM's files are such).

    Raises:
        FileFormatError: no such file, a line without four numbers, times that do not rise, or no line at all.
    """
    path = Path(path)
    rows = [(number, words[:4]) for number, words in _rows(path)]
    values = _numbers(path, rows, 4)
    _refuse(
        path,
        rows,
        np.diff(values[:, 0], prepend=-np.inf) <= 0,
        "its time is not after that of the line above",
    )
    return PositionLog(values[:, 0].copy(), values[:, 1:4].copy())


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
        trajectory: places and times.
        path: the file, replaced in one step.
        format: tum, kitti (which holds no times) or euroc.
        with_covariance: TUM's 29 columns.

    Raises:
        ConfigError: the covariance is not known, or the format holds none.
        WorkspaceError: the file cannot be written.
    """
    places = trajectory.world_from_body
    if with_covariance and (format != "tum" or trajectory.covariance is None):
        raise ConfigError("covariances are written in TUM's form, of a trajectory that has them")
    with atomic_write(path) as aside, aside.open("w", encoding="utf-8") as file:
        if format == "kitti":
            matrices = np.concatenate([places.rotation, places.translation[:, :, None]], axis=2)
            file.writelines(f"{exact_text(row)}\n" for row in matrices.reshape(-1, 12))
            return
        wxyz = Rotation3(places.rotation).as_quat_wxyz()
        if format == "euroc":
            file.write("#timestamp [ns],x [m],y [m],z [m],qw [],qx [],qy [],qz []\n")
            for t, p, q in zip(trajectory.timestamp_s, places.translation, wxyz):
                file.write(f"{round(t / _NS)},{exact_text([*p, *q], ',')}\n")
            return
        file.write("# timestamp tx ty tz qx qy qz qw" + (_COVARIANCE_WORDS if with_covariance else "") + "\n")
        for n, (t, p, q) in enumerate(zip(trajectory.timestamp_s, places.translation, wxyz)):
            values = [*p, *q[[1, 2, 3, 0]]]
            if with_covariance and trajectory.covariance is not None:
                values += [*trajectory.covariance[n][_UPPER]]
            file.write(f"{t:.9f} {exact_text(values)}\n")


def exact_text(values: Iterable[float], separator: str = " ") -> str:
    """Numbers with as many digits as it takes to read the same numbers again: in UTM, nine would be a grid of centimetres."""
    return separator.join(repr(float(value)) for value in values)


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Number and words of each line that holds something."""
    out = []
    for number, line in enumerate(file_text(path).splitlines(), 1):
        words = line.replace(",", " ").split()
        if words and not words[0].startswith("#"):
            out.append((number, words))
    if not out:
        raise FileFormatError(path, "holds no instant of a trajectory")
    return out


def _format_of(path: Path, first: tuple[int, list[str]]) -> TrajectoryFormat:
    number, words = first
    if len(words) == _KITTI:
        return "kitti"
    if path.suffix.lower() == ".csv" and len(words) >= _EUROC:
        return "euroc"
    if len(words) in (_TUM, _TUM_WITH_COVARIANCE):
        return "tum"
    raise FileFormatError(
        path,
        f"line {number}: {len(words)} columns are no trajectory's (TUM has 8 or 29, KITTI 12, EuRoC's CSV 8 or more)",
    )


def _numbers(path: Path, rows: list[tuple[int, list[str]]], at_least: int) -> np.ndarray:
    count = len(rows[0][1])
    out = np.empty((len(rows), count))
    for n, (number, words) in enumerate(rows):
        if len(words) != count or count < at_least:
            raise FileFormatError(
                path, f"line {number}: {len(words)} columns, {max(count, at_least)} expected"
            )
        try:
            out[n] = words
        except ValueError as error:
            raise FileFormatError(path, f"line {number}: {error}") from error
    # A variance may be infinite: that of a place of which nothing is known.
    wrong = np.asarray(~np.isfinite(out[:, :at_least]).all(axis=1) | np.isnan(out).any(axis=1))
    _refuse(path, rows, wrong, "a number is not finite")
    return out


def _refuse(path: Path, rows: list[tuple[int, list[str]]], wrong: np.ndarray, why: str) -> None:
    if wrong.any():
        raise FileFormatError(path, f"line {rows[int(np.argmax(wrong))][0]}: {why}")
