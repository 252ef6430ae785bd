"""A trained neural field as a file: NumPy's .npz, with tables and network in half precision."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.io.atomic import atomic_write
from epipole.io.voxel_files import LARGEST, MOST_SIDE, arrays_in, unpacked_cells

MOST_LEVELS, MOST_ROWS, MOST_WIDTH, LAYERS = 32, 1 << 24, 1024, 5


@dataclass(frozen=True, slots=True, eq=False)
class HashContents:
    """What a file holds."""

    occupied: np.ndarray
    """(x, y, z) bool."""
    low: np.ndarray
    """(3,) the corner of these cells in the world."""
    size: float
    """Of such a cell."""
    cells: np.ndarray
    """(levels,) cells along the longest side, at each level."""
    tables: np.ndarray
    """(levels, rows, 4) float32."""
    weights: tuple[np.ndarray, ...]
    """Of the five layers, (inputs, outputs) each."""


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


def read_hash(path: str | Path) -> HashContents:
    """Read a neural field.

    Raises:
        FileFormatError: it is no such file, is damaged, or promises what it does not hold.
    """
    path = Path(path)
    names = [f"layer{n}" for n in range(LAYERS)]
    place, levels, tables, *weights = arrays_in(path, "place", "levels", "tables", *names)
    occupied = unpacked_cells(path)
    if place.shape != (4,) or place.dtype.kind != "f" or not np.isfinite(place).all() or place[3] <= 0:
        raise FileFormatError(path, "does not tell where the field is")
    if levels.dtype != np.int32 or levels.ndim != 1 or not 1 <= len(levels) <= MOST_LEVELS:
        raise FileFormatError(path, "does not tell its levels")
    if not ((levels > 0) & (levels <= MOST_SIDE)).all():
        raise FileFormatError(path, "a level has an impossible number of cells")
    rows = tables.shape[1] if tables.ndim == 3 else 0
    if tables.dtype != np.float16 or tables.shape != (len(levels), rows, 4) or rows < 1 or rows & (rows - 1):
        raise FileFormatError(path, "tables do not fit the levels")
    _check_layers(path, weights, 4 * len(levels))
    if not all(np.isfinite(one).all() for one in (tables, *weights)):
        raise FileFormatError(path, "a value is not finite")
    told = tuple(one.astype(np.float32) for one in weights)
    return HashContents(
        occupied, place[:3], float(place[3]), levels.astype(np.int64), tables.astype(np.float32), told
    )


def _check_layers(path: Path, weights: list[np.ndarray], features: int) -> None:
    """Two layers to density and 15 features, three more from these and 16 harmonics to a colour."""
    width = weights[0].shape[1] if weights[0].ndim == 2 else 0
    wanted = [(features, width), (width, 16), (32, width), (width, width), (width, 3)]
    if not 1 <= width <= MOST_WIDTH or [one.shape for one in weights] != wanted:
        raise FileFormatError(path, "the layers of the network do not fit each other")
    if any(one.dtype != np.float16 for one in weights):
        raise FileFormatError(path, "the layers of the network are not in half precision")
