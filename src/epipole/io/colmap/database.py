"""COLMAP's database.db: cameras, rigs, frames, images, features, matches and verified pairs.

The format is that of COLMAP 4, so its mappers can start from it; older databases can also be read. The half-pixel
offset (see `io.colmap`) is added to keypoints, principal points, fundamental matrices and homographies.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from epipole._checks import checked
from epipole.errors import FileFormatError, WorkspaceError
from epipole.io.atomic import atomic_write
from epipole.io.colmap._database_reading import matched_pairs, read_contents
from epipole.io.colmap._database_tables import SCHEMA, SCHEMA_VERSION, DatabaseReader
from epipole.io.colmap._database_tables import DatabaseContents as DatabaseContents
from epipole.io.colmap._database_writing import check_contents, insert_contents
from epipole.io.files import require_file

_SIDE_FILES = ("-wal", "-shm", "-journal")


@checked
def write_database(path: str | Path, contents: DatabaseContents) -> None:
    """Write a database atomically, replacing any existing one. Ids are row + 1.

    Keypoints are written as two columns (x, y). A camera shared by several sensors is written once per sensor.

    Raises:
        ConfigError: an image's name is empty, used twice or cannot be written.
        ShapeError: matches, descriptors or GPS do not fit the images, or a pair is given twice.
        WorkspaceError: the file cannot be written.
    """
    check_contents(contents)
    path = Path(path).resolve()
    with atomic_write(path) as part:
        try:
            with closing(sqlite3.connect(part, isolation_level=None)) as connection:
                connection.execute("PRAGMA journal_mode = OFF")
                connection.execute("PRAGMA synchronous = OFF")
                connection.execute("BEGIN")
                for statement in SCHEMA:
                    connection.execute(statement)
                connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
                insert_contents(connection, contents)
                connection.execute("COMMIT")
        except sqlite3.Error as error:
            raise WorkspaceError(f"cannot write {path}: {error}") from error
        # Journals left by a crash of an older database would be replayed into the new one.
        for suffix in _SIDE_FILES:
            path.with_name(path.name + suffix).unlink(missing_ok=True)


@checked
def read_database(path: str | Path, *, with_pairs: bool = True) -> DatabaseContents:
    """Read a database without writing to its folder; rows are in the order of its ids.

    Args:
        path: the file.
        with_pairs: read matches and verified pairs, too, which are most of a database.

    Raises:
        FileFormatError: the file is not a COLMAP database, a cell is truncated, or an id is missing.
    """
    with _opened(Path(path)) as database:
        return read_contents(database, with_pairs=with_pairs)


@checked
def read_matched_pairs(path: str | Path) -> Int32[np.ndarray, "p 2"]:
    """Rows (i, j), i < j, of the images of each pair with matches, sorted; much faster than reading the matches.

    Raises:
        FileFormatError: the file is not a COLMAP database, or an id is missing.
    """
    with _opened(Path(path)) as database:
        return matched_pairs(database)


@contextmanager
def _opened(path: Path) -> Iterator[DatabaseReader]:
    """Open a database without writing to its folder, and convert all errors in the block to `FileFormatError`."""
    num_bytes = require_file(path)
    beside = [side for s in _SIDE_FILES if (side := path.with_name(path.name + s)).exists()]
    in_use, num_bytes = bool(beside), num_bytes + sum(require_file(side) for side in beside)
    uri = f"{path.resolve().as_uri()}?mode=ro{'' if in_use else '&immutable=1'}"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as connection:
            yield DatabaseReader(path, connection, num_bytes)
    except FileFormatError:
        raise
    except sqlite3.Error as error:
        raise FileFormatError(
            path, f"not a readable database: {error}; check that this is COLMAP's database.db"
        ) from error
    except (TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(path, f"a cell has an invalid value: {error}") from error
