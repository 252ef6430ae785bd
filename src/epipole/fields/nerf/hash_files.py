"""Files of trained neural fields: NumPy .npz, with tables and network in half precision."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from epipole._checks import Declared, check_fields, checked
from epipole._checks.tables import Expected, Table
from epipole.errors import FileFormatError, ShapeError
from epipole.fields.nerf.voxel_files import CELLS, LARGEST, MOST_SIDE, unpacked_cells
from epipole.io.array_files import read_packed_arrays
from epipole.io.atomic import atomic_write

MOST_LEVELS, MOST_WIDTH, LAYERS = 32, 1024, 5
HASH: Table = {
    **CELLS,
    "place": Expected("float64", "4"),
    "levels": Expected("int64", "l", least=1, most=MOST_SIDE),
    "tables": Expected("float16", "l _ 4"),
    **{f"layer{n}": Expected("float16", "_ _") for n in range(LAYERS)},
}


@dataclass(frozen=True, slots=True, eq=False)
class HashContents(Declared):
    """Contents of a file."""

    occupied: Bool[np.ndarray, "x y z"]
    """(x, y, z) bool."""
    low: Float64[np.ndarray, " 3"]
    """(3,) corner of the cells in the world."""
    size: float
    """Size of a cell."""
    cells: Int64[np.ndarray, " l"]
    """(levels,) cells along the longest side, at each level."""
    tables: Float32[np.ndarray, "l r 4"]
    """(levels, rows, 4) float32."""
    weights: tuple[Float32[np.ndarray, "_ _"], ...]
    """(inputs, outputs) of each of the five layers."""

    def __post_init__(self) -> None:
        """Check the arrays.

        Raises:
            ShapeError: there are not five layers, or an array has the wrong type or shape.
        """
        check_fields(self)
        if len(self.weights) != LAYERS:
            raise ShapeError(f"weights must be of {LAYERS} layers, got {len(self.weights)}")


@checked
def write_hash(path: str | Path, field: HashContents) -> None:
    """Write a neural field.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    first, second, third, fourth, fifth = (_halved(layer) for layer in field.weights)
    data = io.BytesIO()
    np.savez_compressed(
        data,
        shape=np.array(field.occupied.shape, np.int32),
        cells=np.packbits(field.occupied),
        place=np.array([*field.low.tolist(), field.size]),
        levels=np.asarray(field.cells, np.int32),
        tables=_halved(field.tables),
        layer0=first,
        layer1=second,
        layer2=third,
        layer3=fourth,
        layer4=fifth,
    )
    with atomic_write(Path(path)) as part:
        part.write_bytes(data.getvalue())


def _halved(values: np.ndarray) -> np.ndarray:
    return np.clip(values, -LARGEST, LARGEST).astype(np.float16)


@checked
def read_hash(path: str | Path) -> HashContents:
    """Read a neural field.

    Raises:
        FileFormatError: it is not such a file, or is damaged.
    """
    path = Path(path)
    arrays = read_packed_arrays(path, HASH)
    position, levels, tables = (arrays[name] for name in ("place", "levels", "tables"))
    weights = [arrays[f"layer{n}"] for n in range(LAYERS)]
    rows = tables.shape[1]
    if position[3] <= 0:
        raise FileFormatError(path, "the size of a cell is not positive")
    if not 1 <= len(levels) <= MOST_LEVELS:
        raise FileFormatError(path, f"has {len(levels)} levels, not 1 to {MOST_LEVELS}")
    if rows < 1 or rows & (rows - 1):
        raise FileFormatError(path, f"has tables of {rows} rows, which is not a power of two")
    _check_layers(path, weights, 4 * len(levels))
    layers = tuple(one.astype(np.float32) for one in weights)
    occupied = unpacked_cells(path, arrays)
    return HashContents(occupied, position[:3], float(position[3]), levels, tables.astype(np.float32), layers)


def _check_layers(path: Path, weights: list[np.ndarray], features: int) -> None:
    """Check the shapes: two layers for density and 15 features, three for color from these and 16 harmonics."""
    width = weights[0].shape[1]
    wanted = [(features, width), (width, 16), (32, width), (width, width), (width, 3)]
    if not 1 <= width <= MOST_WIDTH or [one.shape for one in weights] != wanted:
        raise FileFormatError(path, "the shapes of the network's layers do not match")
