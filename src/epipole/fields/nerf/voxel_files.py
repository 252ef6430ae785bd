"""Files of trained grids: NumPy .npz, with values in half precision."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64

from epipole._checks import Declared, checked
from epipole._checks.tables import Arrays, Expected, Table
from epipole.errors import FileFormatError
from epipole.io.array_files import read_packed_arrays
from epipole.io.atomic import atomic_write

MOST_SIDE = 2048
"""Cells along a side, at most."""
WIDTH = 13
"""Values of a row that are written."""
LARGEST = 6e4
"""Largest value in half precision."""
MOST_CELLS = 1 << 25
"""Cells of a file, at most: twice those of a training. The row index of each corner takes four bytes."""
CELLS: Table = {"shape": Expected("int32", "3", least=1, most=MOST_SIDE), "cells": Expected("uint8", "_")}
GRID: Table = {**CELLS, "values": Expected("float16", f"_ {WIDTH}"), "place": Expected("float64", "5")}


@dataclass(frozen=True, slots=True, eq=False)
class GridContents(Declared):
    """Contents of a file."""

    cells: Bool[np.ndarray, "x y z"]
    """(x, y, z) bool, whether a cell is occupied."""
    values: Float32[np.ndarray, "n 13"]
    """(rows, 13) float32 values of the corners, in the order of corners."""
    low: Float64[np.ndarray, " 3"]
    """(3,) corner of the grid in the world."""
    size: float
    """Size of a voxel."""
    unit: float
    """Length unit of the densities."""


@checked
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


@checked
def read_grid(path: str | Path) -> GridContents:
    """Read a grid.

    Raises:
        FileFormatError: it is not such a file, or is damaged.
    """
    path = Path(path)
    arrays = read_packed_arrays(path, GRID)
    position = arrays["place"]
    if not (position[3:] > 0).all():
        raise FileFormatError(path, "a length is not positive")
    values = arrays["values"].astype(np.float32)
    return GridContents(
        unpacked_cells(path, arrays), values, position[:3], float(position[3]), float(position[4])
    )


@checked
def unpacked_cells(path: Path, arrays: Arrays) -> np.ndarray:
    """(x, y, z) bool, the occupied cells in the file of a grid or a neural field.

    Raises:
        FileFormatError: there are too many, or their number does not match the shape.
    """
    shape, packed = arrays["shape"], arrays["cells"]
    count = math.prod(shape.tolist())
    if count > MOST_CELLS:
        raise FileFormatError(path, f"is a grid of {count} cells, more than {MOST_CELLS}")
    if len(packed) != -(-count // 8):
        raise FileFormatError(path, "the number of cells does not match the shape of the grid")
    return np.unpackbits(packed, count=count).astype(bool).reshape(shape)
