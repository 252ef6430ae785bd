"""Common interface of fields that are rendered by ray marching: explicit grids and neural fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from epipole.cameras import Camera
from epipole.errors import FileFormatError
from epipole.fields.nerf.hash_field import HashField, Room, render_hash, voxels_of
from epipole.fields.nerf.hash_files import HashContents, read_hash, write_hash
from epipole.fields.nerf.hash_trainer import HashTrainer
from epipole.fields.nerf.voxel_field import Voxels, corners_of, render_voxels, unit_of, voxels_on
from epipole.fields.nerf.voxel_files import WIDTH, GridContents, read_grid, write_grid
from epipole.fields.nerf.voxel_trainer import VoxelTrainer
from epipole.fields.rays import blocks_of
from epipole.fields.trainer import Trainer
from epipole.fields.training_view import TrainingView
from epipole.geometry import Rigid3

Field = Any
"""Voxels, or a HashField."""


@dataclass(frozen=True, slots=True, eq=False)
class Kind:
    """Functions to train, store and render one kind of field."""

    file: str
    """File name in an output folder."""
    count: str
    """Name of its size in a summary."""
    trainer: Callable[[Sequence[TrainingView], np.ndarray, int], Trainer]
    write: Callable[[Path, Field], None]
    read: Callable[[Path], Field]
    render: Callable[[Field, Camera, Rigid3, np.ndarray], tuple[np.ndarray, np.ndarray, int]]
    """Image, depth along rays times coverage, and number of evaluations."""
    voxels: Callable[[Field], Voxels]
    """Conversion to an explicit grid."""
    positions: Callable[[Field], np.ndarray]
    """(n, 3) centers of non-empty cells."""


def kind_in(path: Path) -> tuple[Kind, Path] | None:
    """Kind and file of a trained field, given its file or output folder; None if there is none."""
    for kind in KINDS.values():
        file = path if path.name == kind.file else path / kind.file
        if file.is_file():
            return kind, file
    return None


def read_voxels(path: Path) -> Voxels:
    """Read a grid written by `nerf`.

    Raises:
        FileFormatError: the file is damaged.
    """
    found = read_grid(path)
    rows = int(corners_of(found.cells).sum())
    if rows != len(found.values):
        raise FileFormatError(
            path, f"has {len(found.values)} rows of values, but its cells have {rows} corners"
        )
    return voxels_on(found.cells, found.low, found.size, found.unit, found.values)


def _write_voxels(path: Path, voxels: Voxels) -> None:
    cells = voxels.occupied.astype(bool)
    contents = GridContents(cells, voxels.values[:, :WIDTH], voxels.low, voxels.size, unit_of(voxels))
    write_grid(path, contents)


def _positions_of_voxels(voxels: Voxels) -> np.ndarray:
    cells = voxels.seen if voxels.seen.any() else voxels.occupied
    return voxels.low + voxels.size * (np.argwhere(cells) + 0.5)


def read_neural(path: Path) -> HashField:
    """Read a neural field written by `nerf`.

    Raises:
        FileFormatError: the file is damaged.
    """
    found = read_hash(path)
    room = Room(found.occupied.astype(np.uint8), blocks_of(found.occupied), found.low, found.size)
    return HashField(room, found.cells, found.tables, found.weights)


def _write_neural(path: Path, field: HashField) -> None:
    room = field.room
    occupied = room.occupied.astype(bool)
    write_hash(path, HashContents(occupied, room.low, room.size, field.cells, field.tables, field.weights))


def _positions_of_neural(field: HashField) -> np.ndarray:
    return field.room.low + field.room.size * (np.argwhere(field.room.occupied) + 0.5)


KINDS = {
    "grid": Kind(
        "grid.npz",
        "num_voxels",
        VoxelTrainer,
        _write_voxels,
        read_voxels,
        render_voxels,
        lambda voxels: voxels,
        _positions_of_voxels,
    ),
    "hash": Kind(
        "hash.npz",
        "num_parameters",
        HashTrainer,
        _write_neural,
        read_neural,
        render_hash,
        voxels_of,
        _positions_of_neural,
    ),
}
"""Kinds by `NerfTraining.kind`."""
