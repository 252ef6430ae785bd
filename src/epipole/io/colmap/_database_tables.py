"""The schema of COLMAP's database (version 4), its blobs, and the columns that it is read into."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int32, UInt8
from numpy.typing import DTypeLike

from epipole._checks import Declared, check_fields, check_indices
from epipole.errors import FileFormatError
from epipole.io.colmap._tables import UNKNOWN_POSE
from epipole.io.colmap.cameras import HALF_PIXEL
from epipole.io.files import problem_of_name
from epipole.robust.pairs.kind import PairKind
from epipole.scene import Cameras, Frames, Images, Rigs, ViewGraph

SCHEMA_VERSION = 4020100
"""COLMAP's version number for this schema (4.2.1); newer versions migrate from it."""
MAX_IMAGES = 2147483647
"""A pair is stored as MAX_IMAGES * smaller id + larger id."""
WGS84 = 0
_LEAST_ROW = 5
"""Smallest size of a table row in the file, bytes."""
_BLOBS = frozenset(("data", "params", "sensor_from_rig", "position", "F", "E", "H", "qvec", "tvec"))
_STEPS_PER_CALL, _MOST_STEPS, _MOST_STEPS_PER_BYTE = 10_000, 1_000_000, 10
SIFT_DESCRIPTOR = 0
HALF_SHIFT = np.array([[1.0, 0.0, HALF_PIXEL], [0.0, 1.0, HALF_PIXEL], [0.0, 0.0, 1.0]])
"""colmap_pixel = HALF_SHIFT @ pixel, both homogeneous."""

CONFIG_OF_KIND = {
    PairKind.DEGENERATE: 1,
    PairKind.GENERAL: 2,  # CALIBRATED
    PairKind.UNCALIBRATED: 3,
    PairKind.PLANAR: 4,
    PairKind.ROTATION: 5,  # PANORAMIC
    PairKind.NO_MOTION: 5,  # a rotation by zero; COLMAP has no configuration for it
}
# PLANAR_OR_PANORAMIC (6) still has a homography; UNDEFINED (0), WATERMARK (7) and MULTIPLE (8) have no
# model at all; CALIBRATED_RIG (9) was verified through the rig's poses.
KIND_OF_CONFIG = {
    **{1: PairKind.DEGENERATE, 2: PairKind.GENERAL, 3: PairKind.UNCALIBRATED},
    **{4: PairKind.PLANAR, 5: PairKind.ROTATION, 6: PairKind.PLANAR},
    **{0: PairKind.DEGENERATE, 7: PairKind.DEGENERATE, 8: PairKind.DEGENERATE, 9: PairKind.GENERAL},
}

SCHEMA = (
    """CREATE TABLE cameras (
        camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
        model INTEGER NOT NULL, width INTEGER NOT NULL, height INTEGER NOT NULL,
        params BLOB, prior_focal_length INTEGER NOT NULL)""",
    """CREATE TABLE rigs (
        rig_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
        ref_sensor_id INTEGER NOT NULL, ref_sensor_type INTEGER NOT NULL)""",
    "CREATE UNIQUE INDEX rig_ref_sensor_assignment ON rigs(ref_sensor_id, ref_sensor_type)",
    """CREATE TABLE rig_sensors (
        rig_id INTEGER NOT NULL, sensor_id INTEGER NOT NULL, sensor_type INTEGER NOT NULL,
        sensor_from_rig BLOB,
        FOREIGN KEY(rig_id) REFERENCES rigs(rig_id) ON DELETE CASCADE)""",
    "CREATE UNIQUE INDEX rig_sensor_assignment ON rig_sensors(sensor_id, sensor_type)",
    """CREATE TABLE frames (
        frame_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, rig_id INTEGER NOT NULL,
        FOREIGN KEY(rig_id) REFERENCES rigs(rig_id) ON DELETE CASCADE)""",
    """CREATE TABLE frame_data (
        frame_id INTEGER NOT NULL, data_id INTEGER NOT NULL,
        sensor_id INTEGER NOT NULL, sensor_type INTEGER NOT NULL,
        FOREIGN KEY(frame_id) REFERENCES frames(frame_id) ON DELETE CASCADE)""",
    "CREATE UNIQUE INDEX frame_sensor_assignment ON frame_data(data_id, sensor_type)",
    """CREATE TABLE images (
        image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
        name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL,
        CONSTRAINT image_id_check CHECK(image_id >= 0 and image_id < 2147483647),
        FOREIGN KEY(camera_id) REFERENCES cameras(camera_id))""",
    "CREATE UNIQUE INDEX index_name ON images(name)",
    """CREATE TABLE pose_priors (
        pose_prior_id INTEGER PRIMARY KEY NOT NULL,
        corr_data_id INTEGER NOT NULL, corr_sensor_id INTEGER NOT NULL, corr_sensor_type INTEGER NOT NULL,
        position BLOB, position_covariance BLOB, gravity BLOB, coordinate_system INTEGER NOT NULL)""",
    """CREATE UNIQUE INDEX pose_prior_data_assignment
        ON pose_priors(corr_data_id, corr_sensor_id, corr_sensor_type)""",
    """CREATE TABLE keypoints (
        image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
        FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE)""",
    """CREATE TABLE descriptors (
        image_id INTEGER PRIMARY KEY NOT NULL, type INTEGER NOT NULL,
        rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
        FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE)""",
    """CREATE TABLE matches (
        pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB)""",
    """CREATE TABLE two_view_geometries (
        pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
        config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB, camera1 BLOB, camera2 BLOB)""",
)


@dataclass(frozen=True, slots=True, eq=False)
class DatabaseContents(Declared):
    """The content of a database in rows; `frames` has no poses, since a database does not store any."""

    cameras: Cameras
    rigs: Rigs
    frames: Frames
    images: Images
    descriptors: Sequence[UInt8[np.ndarray, "_ _"] | None] | None = None
    """For each image, one row per keypoint; None if it has none."""
    matches: Mapping[tuple[int, int], Int32[np.ndarray, "_ 2"]] = field(default_factory=dict)
    """Matches before verification: (image1, image2) -> keypoint in image1, keypoint in image2."""
    view_graph: ViewGraph | None = None
    """Verified pairs."""
    gps_lat_lon_alt: Float64[np.ndarray, "n 3"] | None = None
    """For each image latitude and longitude in degrees and altitude in meters (WGS84); NaN where unknown."""

    def __post_init__(self) -> None:
        """Check the consistency of the rows.

        Raises:
            ShapeError: a sensor refers to a missing camera, or an image to a missing sensor.
            ConfigError: a field has the wrong type.
        """
        check_fields(self)
        check_indices(self.rigs.sensor_camera, "rigs.sensor_camera", len(self.cameras))
        check_indices(self.images.sensor, "images.sensor", len(self.rigs.sensor_camera))

    def __repr__(self) -> str:
        pairs = 0 if self.view_graph is None else len(self.view_graph)
        return f"DatabaseContents({self.images}, {len(self.matches)} matched and {pairs} verified pairs)"


def blob(array: np.ndarray, dtype: DTypeLike) -> bytes | None:
    """Values in row-major order; None (an empty cell) if any is not finite."""
    return np.ascontiguousarray(array, dtype).tobytes() if np.isfinite(array).all() else None


class DatabaseReader:
    """Read-only access to the tables of any version; every error names the file.

    A schema can contain code, and a damaged page tree can refer to a page repeatedly: only plain tables are read, and
    no more data than a file of this size can contain.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, num_bytes: int) -> None:
        self.path = path
        self._connection = connection
        self._num_bytes = num_bytes
        self._calls_left = (_MOST_STEPS + _MOST_STEPS_PER_BYTE * num_bytes) // _STEPS_PER_CALL
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(min(num_bytes, 10**9), 1 << 20))
        for setting in ("trusted_schema = OFF", "cell_size_check = ON", "query_only = ON", "mmap_size = 0"):
            connection.execute(f"PRAGMA {setting}")
        connection.set_progress_handler(self._is_out_of_steps, _STEPS_PER_CALL)

    def _is_out_of_steps(self) -> bool:
        self._calls_left -= 1
        return self._calls_left < 0

    def columns(self, table: str) -> set[str]:
        """Names of a table's columns, without generated ones; empty if there is no such table."""
        of_name = (
            "SELECT type = 'table' AND rootpage > 0 FROM sqlite_master WHERE name = ? AND type != 'trigger'"
        )
        if not all(row[0] for row in self._connection.execute(of_name, (table,))):
            raise self.fail(f"table {table}", "it is a view or a virtual table, not a plain table")
        return {row[1] for row in self._connection.execute(f"PRAGMA table_info({table})")}

    def rows(self, table: str, columns: str, order: str) -> list[tuple]:
        """All rows of a table; empty if there is no such table.

        Raises:
            FileFormatError: a column is missing, a cell has the wrong type, or there are more rows than the file can
                contain.
        """
        there = self.columns(table)
        if not there:
            return []
        names = columns.split(", ")
        missing = next((name for name in names if name.isidentifier() and name not in there), None)
        if missing is not None:
            raise self.fail(f"table {table}", f"not a readable database: column {missing} is missing")
        found: list[tuple] = []
        size = 0
        for row in self._connection.execute(f"SELECT {columns} FROM {table} ORDER BY {order}"):
            size += _LEAST_ROW
            for name, cell in zip(names, row):
                if name in _BLOBS:
                    size += 0 if cell is None else len(cell)
                    is_sound = cell is None or isinstance(cell, bytes)
                elif name == "name":
                    size += len(cell) if isinstance(cell, str) else 0
                    is_sound = problem_of_name(cell) is None
                else:
                    is_sound = isinstance(cell, int) or name in ("rows", "cols") or not name.isidentifier()
                if not is_sound:
                    what = problem_of_name(cell) if name == "name" else f"{name} is {str(cell)[:40]!r}"
                    raise self.fail(f"table {table}", f"row {len(found) + 1}: {what}")
            if size > self._num_bytes:
                raise self.fail(f"table {table}", "it has more rows than the file can contain")
            found.append(row)
        return found

    def fail(self, position: str, problem: str) -> FileFormatError:
        """The error to raise for a row."""
        return FileFormatError(self.path, f"{position}: {problem}")

    def matrix(self, data: object, dtype: DTypeLike, rows: object, cols: object, position: str) -> np.ndarray:
        """A cell with rows x cols values; an empty cell is a matrix without rows."""
        dtype = np.dtype(dtype)
        if not isinstance(rows, int) or not isinstance(cols, int) or rows < 0 or cols < 0:
            raise self.fail(position, f"impossible size {rows} x {cols}")
        content = data if isinstance(data, bytes) else b""
        if len(content) != rows * cols * dtype.itemsize:
            raise self.fail(position, f"{rows} x {cols} values do not take {len(content)} bytes")
        return np.frombuffer(content, dtype).reshape(rows, cols)

    def numbers(self, data: object, count: int, position: str) -> np.ndarray:
        """A cell with `count` doubles; NaN if it is empty."""
        if not isinstance(data, bytes) or len(data) == 0:
            return np.full(count, np.nan)
        return self.matrix(data, "<f8", 1, count, position)[0]

    def pose(self, data: object, position: str) -> np.ndarray:
        """A cell with a pose (7,); NaN if it is empty."""
        return self.numbers(data, 7, position) if data is not None else UNKNOWN_POSE
