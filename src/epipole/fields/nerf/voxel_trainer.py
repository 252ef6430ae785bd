"""Trainer for an explicit grid, coarse to fine; cells that are empty at one resolution are dropped at the next."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32
from scipy import ndimage

from epipole import _parallel
from epipole._checks import check_fraction, check_seed, checked
from epipole._checks.tables import Expected, Table, check_arrays
from epipole.errors import ShapeError
from epipole.fields.nerf import _voxel_kernels as kernels
from epipole.fields.nerf.voxel_field import (
    Voxels,
    corners_of,
    march_work,
    render_voxels,
    voxels_on,
)
from epipole.fields.random_state import STATE, set_state, state_of
from epipole.fields.rays import pixels_to_render, rays_of
from epipole.fields.splat._simd_kernels import ROW
from epipole.fields.splat.starting import first_cells
from epipole.fields.training_view import TrainingView

SIZES = ((0.0, 64), (0.08, 128), (0.30, 256))
"""(fraction of the training from which it applies, cells along the side of the grid)."""
RAYS = 4096
"""Rays of a step."""
TOGETHER = 512
"""Rays processed as one task."""
SAMPLES = 96
"""Mean samples per ray for which memory is reserved; rays beyond the capacity are skipped in that step."""
PLANES_TOGETHER = 4
DENSITY_RATE, COLOR_RATE, LAST_RATES = 0.3, 0.015, 0.1


class GridAdam(NamedTuple):
    """Adam state, flat, and the gradient."""

    gradient: np.ndarray
    mean: np.ndarray
    square: np.ndarray
    touched: np.ndarray
    rates: np.ndarray


class VoxelTrainer:
    """Trains a grid on views; the result does not depend on the number of threads.

    Attributes:
        field: current grid.
        num_steps: steps taken.
        num_samples: samples of the last step.
    """

    @checked
    def __init__(
        self, views: Sequence[TrainingView], background: Float32[np.ndarray, " 3"], seed: int = 0
    ) -> None:
        """Start with all cells occupied that the cameras look at.

        Raises:
            ConfigError: there is no view, the masks leave no pixel, or the seed is negative.
            ShapeError: the background is not finite.
            DegenerateGeometryError: the cameras see nothing in common.
        """
        check_seed(seed)
        if not np.isfinite(background).all():
            raise ShapeError("background must be finite")
        self.rays = rays_of(views)
        self.background = background
        self.num_steps = self.num_samples = 0
        self._rng = np.random.default_rng([21, seed])
        low, self._unit, full = first_cells(views, SIZES[0][1])
        self.field = voxels_on(full, low, self._unit, self._unit)
        self._pixel = _pixel_size(views, low + 0.5 * self._unit * np.array(full.shape))
        self._level, self._is_refining = 0, False
        self._adam = _new_adam(self.field)

    @checked
    def step(self, progress: float) -> float:
        """Train on a batch of rays of all images; returns the mean squared error.

        Args:
            progress: fraction of the training that is done, from 0 to 1.

        Raises:
            ConfigError: progress is not from 0 to 1.
        """
        check_fraction(progress, "progress")
        while self._can_refine() and progress >= SIZES[self._level + 1][0]:
            self._refine()
        if not self._is_refining and progress >= self._half_progress():
            self._is_refining = True
            self.field.seen[:] = 0
        fallen = LAST_RATES**progress
        self._adam.rates[:] = fallen * COLOR_RATE
        self._adam.rates[0] = fallen * DENSITY_RATE
        chosen = pixels_to_render(self.rays, RAYS, self._rng)
        first = self._rng.random(RAYS, np.float32)
        parts = self._marched(chosen, first)
        records = np.concatenate([part[0] for part in parts])
        cells = np.concatenate([part[1] for part in parts])
        self._move(records, cells)
        self.num_samples = sum(part[3] for part in parts)
        self.num_steps += 1
        return sum(part[2] for part in parts) / (3 * RAYS)

    @property
    def table(self) -> Table:
        """Arrays of `state`."""
        return {
            "occupied": Expected("uint8", "x y z", most=1),
            "seen": Expected("uint8", "x y z", most=1),
            "values": Expected("float32", f"n {ROW}"),
            "adam_gradient": Expected("float32", "g"),
            "adam_mean": Expected("float32", "g"),
            "adam_square": Expected("float32", "g", least=0),
            "adam_touched": Expected("uint8", "n", most=1),
            "adam_rates": Expected("float32", f"{ROW}", least=0),
            "counts": Expected("int64", "3", least=0),
            "rng": STATE,
        }

    def state(self) -> dict[str, np.ndarray]:
        """All state that the next steps depend on, except the views and what is derived from the cells."""
        return {
            **{name: getattr(self.field, name) for name in ("occupied", "seen", "values")},
            **{f"adam_{name}": part for name, part in self._adam._asdict().items()},
            "counts": np.array([self.num_steps, self._level, self._is_refining], np.int64),
            "rng": state_of(self._rng),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state` of a trainer with the same views, with bit-identical results.

        Raises:
            ShapeError: cells and level, or values and cells, do not match.
        """
        state = check_arrays(state, self.table)
        num_steps, level, is_alike = state["counts"].tolist()
        first, cells = self.field, state["occupied"].astype(bool)
        shape = tuple(side << min(level, len(SIZES)) for side in first.occupied.shape)
        if level >= len(SIZES) or is_alike > 1 or cells.shape != shape:
            raise ShapeError(f"occupied must have the shape {shape} of a level, got {cells.shape}")
        field = voxels_on(cells, first.low, first.size / 2**level, self._unit)
        values = state["values"]
        if values.shape != field.values.shape or state["adam_mean"].size != values.size:
            raise ShapeError(
                f"values must have a row for each of {len(field.values)} corners, got {values.shape}"
            )
        self.field = field._replace(values=values, seen=state["seen"])
        self._adam = GridAdam(*(state[f"adam_{name}"] for name in GridAdam._fields))
        self.num_steps, self._level = num_steps, level
        self._is_refining, self._rows_at = bool(is_alike), None
        set_state(self._rng, state["rng"])

    def _marched(
        self, chosen: np.ndarray, first: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray, float, int]]:
        scale = np.float32(1.0 / (3 * RAYS))

        def track(start: int, stop: int, _: int) -> tuple[np.ndarray, np.ndarray, float, int]:
            room = SAMPLES * (stop - start)
            records = np.empty((room, kernels.RECORD), np.float32)
            cells = np.empty(room, np.int64)
            found, error, samples = kernels.learn_rays(
                self.rays,
                chosen,
                first,
                self.field,
                self.background,
                scale,
                start,
                stop,
                records,
                cells,
                march_work(),
            )
            return records[:found], cells[:found], error, samples

        return _parallel.map_chunks(track, RAYS, RAYS // TOGETHER)

    def _move(self, records: np.ndarray, cells: np.ndarray) -> None:
        """Adam step with one thread per plane of constant x; derivatives are added in the order of cells and rays."""
        planes, ny, nz = self.field.row_of.shape
        keys = cells.astype(np.uint64) << np.uint64(32) | np.arange(len(cells), dtype=np.uint64)
        keys.sort()
        order = (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)
        first_keys = np.arange(planes + 1, dtype=np.uint64) * np.uint64(ny * nz) << np.uint64(32)
        start = np.searchsorted(keys, first_keys)
        _parallel.map_chunks(
            lambda a, b, _: kernels.move_planes(
                self.field,
                records,
                cells,
                order,
                start,
                self._row_start(),
                a,
                b,
                self._adam,
                np.zeros(ROW, np.float32),
            ),
            planes,
            -(-planes // PLANES_TOGETHER),
        )

    def _row_start(self) -> np.ndarray:
        """(planes + 1,) the first row of each plane of constant x."""
        if self._rows_at is None:
            counts = (self.field.row_of >= 0).sum(axis=(1, 2))
            self._rows_at = np.concatenate([[0], np.cumsum(counts)])
        return self._rows_at

    _rows_at: np.ndarray | None = None

    def _can_refine(self) -> bool:
        """Whether there is a finer level and voxels are larger than the images' pixels."""
        return self._level + 1 < len(SIZES) and self.field.size > self._pixel

    def _half_progress(self) -> float:
        """Progress at the middle of this level; seen cells count only from there on, as all is fog at first."""
        ends = [*(fraction for fraction, _ in SIZES), 1.0]
        return 0.5 * (ends[self._level] + ends[self._level + 1])

    def _refine(self) -> None:
        """Drop empty cells, and halve the voxel size."""
        voxels = self.field
        cells = np.repeat(np.repeat(np.repeat(self._seen_cells(), 2, 0), 2, 1), 2, 2)
        values = _between(voxels, np.argwhere(corners_of(cells)))
        field = voxels_on(cells, voxels.low, voxels.size / 2, self._unit, values)
        adam = _new_adam(field)
        # Assigned together: if memory runs out above, all of them keep their old values.
        self.field, self._adam, self._rows_at = field, adam, None
        self._level, self._is_refining = self._level + 1, False

    def _seen_cells(self) -> np.ndarray:
        """Cells in which some ray has seen something, and their neighbors."""
        occupied, seen = self.field.occupied.astype(bool), self.field.seen
        if not seen.any():
            return occupied
        return ndimage.binary_dilation(seen, np.ones((3, 3, 3), bool)) & occupied

    def __len__(self) -> int:
        """Number of corners with a row."""
        return len(self.field.values)

    @checked
    def render(self, view: TrainingView) -> np.ndarray:
        """(h, w, 3) render of a view."""
        return self.render_counted(view)[0]

    def render_counted(self, view: TrainingView) -> tuple[np.ndarray, int]:
        """(h, w, 3) render of a view, and the number of samples."""
        image, _, count = render_voxels(self.field, view.camera, view.cam_from_world, self.background)
        return image, count


def _new_adam(field: Voxels) -> GridAdam:
    n = field.values.size
    gradient, mean, square = (np.zeros(n, np.float32) for _ in range(3))
    return GridAdam(gradient, mean, square, np.zeros(n // ROW, np.uint8), np.zeros(ROW, np.float32))


def _pixel_size(views: Sequence[TrainingView], middle: np.ndarray) -> float:
    """Size of a pixel at the center of the scene: the median of all views."""
    depths = [view.cam_from_world.apply(middle[None])[0, 2] for view in views]
    return float(np.median([depth / view.camera.focal_px for depth, view in zip(depths, views)]))


def _between(voxels: Voxels, corners: np.ndarray) -> np.ndarray:
    """Values at corners (n, 3) of the refined grid: means of the known corners around them."""
    out = np.zeros((len(corners), ROW), np.float32)
    total = np.zeros(len(corners), np.float32)
    half, odd = corners // 2, corners % 2
    for offset in np.ndindex(2, 2, 2):
        wanted = half + np.minimum(offset, odd)
        rows = voxels.row_of[tuple(wanted.T)]
        known = rows >= 0
        out[known] += voxels.values[rows[known]]
        total[known] += 1.0
    return out / np.maximum(total, 1.0)[:, None]
