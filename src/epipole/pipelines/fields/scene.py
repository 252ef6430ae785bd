"""What the viewer shows of trained Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import FileFormatError
from epipole.fields.training_view import TrainingView
from epipole.fields.voxel_field import Voxels, corners_of, gaussians_of, voxels_on
from epipole.io.files import read_json
from epipole.io.gaussian_files import read_gaussians
from epipole.io.voxel_files import read_grid
from epipole.viewer import SplatView, ViewerHandle, view_splats

SPLAT, GRID, SUMMARY, FIRST_VIEW = "splat.ply", "grid.npz", "summary.json", "first_view"
MOST_SHOWN = 800_000
"""Gaussians of a grid."""
LENGTHS = "Lengths are in the unit of the cameras, metres only where these are metric"


def is_mine(path: Path) -> bool:
    """Whether a folder holds trained Gaussians or a grid, or a file is one of Gaussians."""
    if path.suffix.lower() in (".spz", ".splat") and path.is_file():
        return True
    if path.suffix.lower() == ".ply" and path.is_file():
        with path.open("rb") as stream:
            head = stream.read(8192)
        return b" f_dc_0" in head or b" packed_position" in head
    return (path / SPLAT).is_file() or _grid_in(path) is not None


def _grid_in(path: Path) -> Path | None:
    """A grid's file, itself or in an output folder."""
    file = path if path.suffix == ".npz" else path / GRID
    return file if file.is_file() else None


def read_voxels(path: Path) -> Voxels:
    """A grid that `nerf` has written.

    Raises:
        FileFormatError: the file is damaged.
    """
    found = read_grid(path)
    rows = int(corners_of(found.cells).sum())
    if rows != len(found.values):
        raise FileFormatError(
            path, f"holds {len(found.values)} rows of values, its cells have {rows} corners"
        )
    return voxels_on(found.cells, found.low, found.size, found.unit, found.values)


def show(path: Path, *, port: int | None, host: str, block: bool) -> ViewerHandle:
    """The Gaussians, from where one of their pictures was taken.

    Raises:
        FileFormatError: the file is damaged.
    """
    return view_splats(splat_view(path), port=port, host=host, block=block)


def splat_view(path: Path) -> SplatView:
    """Gaussians of an output folder or a file, or those of a grid, as the viewer takes them.

    Raises:
        FileFormatError: the file is damaged.
    """
    grid = _grid_in(path)
    file = grid or (path if path.is_file() else path / SPLAT)
    cloud = read_gaussians(file) if grid is None else gaussians_of(read_voxels(grid), MOST_SHOWN)
    known = told_first_view(file.with_name(SUMMARY))
    if known is None:
        middle = np.median(cloud.means_in_world.astype(np.float64), axis=0)
        size = float(np.median(np.linalg.norm(cloud.means_in_world - middle, axis=1)))
        # As most such files are: the world of a camera, y down.
        away = 3.0 * max(size, 1e-6) * np.array([0.0, -0.3, -1.0])
        known = [middle + away, middle, np.array([0.0, -1.0, 0.0])]
    position, look_at, up = known
    return SplatView(cloud, position, look_at, up, LENGTHS)


def first_view_of(places: np.ndarray, views: Sequence[TrainingView]) -> dict[str, list[float]]:
    """The place of the first view, the middle of what it sees, and what is up, for a job's summary."""
    world_from_camera = views[0].cam_from_world.inverse()
    up = -np.mean([view.cam_from_world.rotation[1] for view in views], axis=0)
    middle = np.median(places.astype(np.float64), axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    return {"position": world_from_camera.translation.tolist(), "look_at": middle.tolist(), "up": up.tolist()}


def told_first_view(summary: Path) -> list[np.ndarray] | None:
    """Position, what is looked at, and up; None where no job has told it, or not in three times three numbers."""
    try:
        content: Any = read_json(summary)
        told = [np.array(content[FIRST_VIEW][name], np.float64) for name in ("position", "look_at", "up")]
    except (FileFormatError, OSError, KeyError, TypeError, ValueError):
        return None
    good = all(part.shape == (3,) and np.isfinite(part).all() for part in told)
    return told if good and np.linalg.norm(told[0] - told[1]) > 0 and told[2].any() else None
