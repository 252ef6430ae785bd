"""A trained grid as a file: NumPy's .npz, with values in half precision."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64

from epipole._declared import Declared, checked
from epipole._declared.tables import Arrays, Expected, Table
from epipole.errors import FileFormatError
from epipole.io.array_files import read_packed_arrays
from epipole.io.atomic import atomic_write

MOST_SIDE, WIDTH, LARGEST = 2048, 13, 6e4
"""Cells along a side, numbers of a row that are written, and the largest of these."""
MOST_CELLS = 1 << 25
"""Of a grid: twice as many as a training makes. The rows of their corners take four bytes each."""
CELLS: Table = {"shape": Expected("int32", "3", least=1, most=MOST_SIDE), "cells": Expected("uint8", "_")}
GRID: Table = {**CELLS, "values": Expected("float16", f"_ {WIDTH}"), "place": Expected("float64", "5")}


@dataclass(frozen=True, slots=True, eq=False)
class GridContents(Declared):
    """What a file holds."""

    cells: Bool[np.ndarray, "x y z"]
    """(x, y, z) bool, which are occupied."""
    values: Float32[np.ndarray, "n 13"]
    """(rows, 13) float32 of their corners, in the order of corners."""
    low: Float64[np.ndarray, " 3"]
    """(3,) the grid's corner in the world."""
    size: float
    """Of a voxel."""
    unit: float
    """Length in which densities are told."""


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
        FileFormatError: it is no such file, is damaged, or promises what it does not hold.
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
    """(x, y, z) bool, the cells of a grid's or neural field's file.

    Raises:
        FileFormatError: there are too many, or they do not fit their number.
    """
    shape, packed = arrays["shape"], arrays["cells"]
    count = math.prod(shape.tolist())
    if count > MOST_CELLS:
        raise FileFormatError(path, f"is a grid of {count} cells, more than {MOST_CELLS}")
    if len(packed) != -(-count // 8):
        raise FileFormatError(path, "the cells do not fit the size of the grid")
    return np.unpackbits(packed, count=count).astype(bool).reshape(shape)
