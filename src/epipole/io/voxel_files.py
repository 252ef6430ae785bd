"""A trained grid as a file: NumPy's .npz, with values in half precision."""

from __future__ import annotations

import io
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError

import numpy as np

from epipole.errors import FileFormatError
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes

MOST_SIDE, WIDTH, LARGEST = 2048, 13, 6e4
"""Cells along a side, numbers of a row that are written, and the largest of these."""
_DAMAGE = (
    *(ValueError, KeyError, OSError, EOFError, TypeError, SyntaxError, MemoryError, ArithmeticError),
    *(zipfile.BadZipFile, zlib.error, TokenError, RuntimeError),
)


@dataclass(frozen=True, slots=True, eq=False)
class GridContents:
    """What a file holds."""

    cells: np.ndarray
    """(x, y, z) bool, which are occupied."""
    values: np.ndarray
    """(rows, 13) float32 of their corners, in the order of corners."""
    low: np.ndarray
    """(3,) the grid's corner in the world."""
    size: float
    """Of a voxel."""
    unit: float
    """Length in which densities are told."""


def write_grid(path: str | Path, grid: GridContents) -> None:
    """Write a grid.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    data = io.BytesIO()
    np.savez_compressed(
        data,
        shape=np.array(grid.cells.shape, np.int32),
        cells=np.packbits(grid.cells),
        values=np.clip(grid.values, -LARGEST, LARGEST).astype(np.float16),
        place=np.array([*grid.low.tolist(), grid.size, grid.unit]),
    )
    with atomic_write(Path(path)) as part:
        part.write_bytes(data.getvalue())


def read_grid(path: str | Path) -> GridContents:
    """Read a grid.

    Raises:
        FileFormatError: it is no such file, is damaged, or promises what it does not hold.
    """
    path = Path(path)
    # A member that is damaged at its begin comes as bytes, without a word: arrays are looked at one by one.
    place, values = arrays_in(path, "place", "values")
    cells = unpacked_cells(path)
    if place.shape != (5,) or place.dtype.kind != "f" or not np.isfinite(place).all():
        raise FileFormatError(path, "does not tell where the grid is")
    if values.ndim != 2 or values.shape[1] != WIDTH or values.dtype != np.float16:
        raise FileFormatError(path, f"values are not rows of {WIDTH} numbers")
    if not np.isfinite(values).all() or not (place[3:] > 0).all():
        raise FileFormatError(path, "a value is not finite, or a length not positive")
    return GridContents(cells, values.astype(np.float32), place[:3], float(place[3]), float(place[4]))


def arrays_in(path: Path, *names: str) -> list[np.ndarray]:
    """Arrays of a file of NumPy's.

    Raises:
        FileFormatError: it is no such file, or one is missing.
    """
    try:
        with np.load(io.BytesIO(file_bytes(path)), allow_pickle=False) as file:
            return [np.asarray(file[name]) for name in names]
    except _DAMAGE as error:
        raise FileFormatError(path, f"is no field that was trained ({error})") from error


def unpacked_cells(path: Path) -> np.ndarray:
    """(x, y, z) bool, the cells of a grid's or neural field's file.

    Raises:
        FileFormatError: they do not fit their number.
    """
    shape, packed = arrays_in(path, "shape", "cells")
    if shape.shape != (3,) or shape.dtype != np.int32 or not ((shape > 0) & (shape <= MOST_SIDE)).all():
        raise FileFormatError(path, "is a grid of impossible size")
    count = int(np.prod(shape.astype(np.int64)))
    if packed.dtype != np.uint8 or packed.shape != (-(-count // 8),):
        raise FileFormatError(path, "the cells do not fit the size of the grid")
    return np.unpackbits(packed, count=count).astype(bool).reshape(shape)
