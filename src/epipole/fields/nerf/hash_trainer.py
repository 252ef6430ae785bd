"""Trainer for a neural radiance field, with hand-written derivatives and an occupancy grid that skips empty space."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from epipole import _parallel
from epipole._checks import check_fraction, check_seed, checked
from epipole._checks.tables import Expected, Table, check_arrays
from epipole.errors import ShapeError
from epipole.fields._adam_kernels import move_touched
from epipole.fields.nerf import _hash_kernels as kernels
from epipole.fields.nerf.hash_field import (
    DELTA,
    FEATURES,
    SAID,
    HashField,
    Room,
    Samples,
    Seen,
    new_weights,
    query_density,
    render_hash,
    sampled,
    seen,
)
from epipole.fields.random_state import STATE, set_state, state_of
from epipole.fields.rays import blocks_of, pixels_to_render, rays_of
from epipole.fields.splat.starting import first_cells
from epipole.fields.training_view import TrainingView

LEVELS = 8
"""Number of feature tables."""
ROWS = 1 << 15
"""Rows of a table."""
COARSEST, FINEST = 16, 512
"""Cells along a side at the first and the last level."""
WIDTH = 64
"""Units of a hidden layer."""
PIECES = 8
"""Tasks that a step is divided into."""
SAMPLES = 4096
"""Target number of samples per task."""
FIRST_RAYS, MOST_RAYS = 512, 16384
"""Rays of the first step, and of any step at most; the number adapts to the samples per ray of the last step."""
LONGEST = 256
"""Samples of a ray, at most."""
TABLE_RATE, LAYER_RATE = 0.1, 0.004
"""Initial learning rates of tables and layers."""
NO_BIAS = np.ones(2, np.float32)
"""No bias correction: the first step of a number then has the size of the learning rate."""
LAST_RATES = 0.1
"""Factor of the learning rates at the end."""
SIDE = 128
"""Cells along the longest side of the occupancy grid."""
CHECK_EVERY = 16
"""Steps between two updates of the occupancy."""
NUM_PARTS = 16
"""One in this number of cells is checked per update."""
WARM_UP = 256
"""Steps before the first cell is marked empty."""
FADE = 0.95
"""Decay of a cell's alpha per update."""
LEAST_ALPHA = 0.01
"""Alpha of a step below which a cell is empty."""


class Marched(NamedTuple):
    """Derivatives from some rays."""

    positions: np.ndarray
    by_features: np.ndarray
    by_weights: tuple[np.ndarray, ...]
    error: float
    """Sum of squared errors."""
    samples: int
    """Number of network queries."""


class HashTrainer:
    """Trains a neural field on views; the result does not depend on the number of threads.

    Attributes:
        field: current field.
        num_steps: steps taken.
        num_samples: network queries of the last step.
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
        self._rng = np.random.default_rng([22, seed])
        low, size, full = first_cells(views, SIDE)
        self._may_be = np.argwhere(full).astype(np.float32)
        self._alpha = np.zeros(len(self._may_be), np.float32)
        room = Room(full.astype(np.uint8), blocks_of(full), low.astype(np.float64), size)
        growth = (FINEST / COARSEST) ** (1.0 / (LEVELS - 1))
        cells = np.floor(COARSEST * growth ** np.arange(LEVELS) + 1e-6).astype(np.int64)
        tables = self._rng.uniform(-1e-4, 1e-4, (LEVELS, ROWS, FEATURES)).astype(np.float32)
        self.field = HashField(room, cells, tables, new_weights(self._rng, LEVELS, WIDTH))
        moved = (tables, *self.field.weights)
        self._gradient, self._mean, self._square = ([np.zeros_like(one) for one in moved] for _ in range(3))
        self._num_rays = FIRST_RAYS

    @checked
    def step(self, progress: float) -> float:
        """Train on a batch of rays of all images; returns the mean squared error.

        Args:
            progress: fraction of the training that is done, from 0 to 1.

        Raises:
            ConfigError: progress is not from 0 to 1.
        """
        check_fraction(progress, "progress")
        count = self._num_rays
        chosen = pixels_to_render(self.rays, count, self._rng)
        first = self._rng.random(count, np.float32) - np.float32(1.0)
        with _parallel.single_threaded_blas():
            parts = _parallel.map_chunks(
                lambda a, b, _: self._marched(chosen[a:b], first[a:b], count), count, PIECES
            )
            self._move(parts, LAST_RATES**progress)
            self.num_steps += 1
            if self.num_steps % CHECK_EVERY == 0:
                self._update_occupancy()
        self.num_samples = sum(part.samples for part in parts)
        wanted = count * PIECES * SAMPLES / max(self.num_samples, 1)
        self._num_rays = int(np.clip(wanted, 0.5 * count, min(2 * count, MOST_RAYS)))
        return sum(part.error for part in parts) / (3 * count)

    @property
    def table(self) -> Table:
        """Arrays of `state`."""
        moved = [" ".join(map(str, one.shape)) for one in (self.field.tables, *self.field.weights)]
        parts = {
            f"{kind}_{n}": Expected("float32", axes, least=0 if kind == "square" else None)
            for kind in ("value", "mean", "square")
            for n, axes in enumerate(moved)
        }
        occupied = " ".join(map(str, self.field.room.occupied.shape))
        return {
            **parts,
            "alpha": Expected("float32", f"{len(self._may_be)}", least=0, most=1),
            "occupied": Expected("uint8", occupied, most=1),
            "counts": Expected("int64", "2", least=0),
            "rng": STATE,
        }

    def state(self) -> dict[str, np.ndarray]:
        """All state that the next steps depend on, except the views."""
        moved = {
            "value": (self.field.tables, *self.field.weights),
            "mean": self._mean,
            "square": self._square,
        }
        return {
            **{f"{kind}_{n}": part for kind, parts in moved.items() for n, part in enumerate(parts)},
            "alpha": self._alpha,
            "occupied": self.field.room.occupied,
            "counts": np.array([self.num_steps, self._num_rays], np.int64),
            "rng": state_of(self._rng),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state` of a trainer with the same views, with bit-identical results.

        Raises:
            ShapeError: the number of rays is out of range.
        """
        state = check_arrays(state, self.table)
        num_steps, num_rays = state["counts"].tolist()
        if not 1 <= num_rays <= MOST_RAYS:
            raise ShapeError(f"counts must have 1 to {MOST_RAYS} rays, got {num_rays}")
        values, self._mean, self._square = (
            [state[f"{kind}_{n}"] for n in range(len(self._mean))] for kind in ("value", "mean", "square")
        )
        occupied = state["occupied"]
        room = self.field.room._replace(occupied=occupied, blocks=blocks_of(occupied > 0))
        self.field = self.field._replace(room=room, tables=values[0], weights=tuple(values[1:]))
        self._alpha = state["alpha"]
        self.num_steps, self._num_rays = num_steps, num_rays
        set_state(self._rng, state["rng"])

    def _marched(self, chosen: np.ndarray, first: np.ndarray, count: int) -> Marched:
        """Forward and backward pass of pixels (n,), out of `count` in this step; first (n,): ray offsets minus 1."""
        field, rays = self.field, self.rays
        view = np.searchsorted(rays.offset, chosen, side="right") - 1
        samples = sampled(field, rays, chosen - rays.offset[view], view, first, LONGEST, 4 * SAMPLES)
        left = np.ones(len(chosen), np.float32)
        part = seen(field, samples, left)
        image = np.zeros((len(chosen), 4), np.float32)
        kernels.compose(part.layers[-1], part.light, samples.positions, part.kept, part.counts, image)
        off = image[:, :3] + left[:, None] * self.background - self._wanted(chosen)
        by_image = np.float32(2.0 / (3 * count)) * off
        behind = left * (by_image @ self.background)
        by_colors, by_raw = np.empty_like(part.layers[-1]), np.empty(len(part.kept), np.float32)
        kernels.compose_back(part.layers[-1], part.light, part.counts, behind, by_image, by_colors, by_raw)
        by_features, by_weights = self._back(samples, part, by_colors, by_raw)
        error = float((off.astype(np.float64) ** 2).sum())
        return Marched(samples.positions[part.kept], by_features, by_weights, error, len(samples.said))

    def _back(
        self, samples: Samples, part: Seen, by_colors: np.ndarray, by_raw: np.ndarray
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """Backpropagation through the layers (Rumelhart, Hinton and Williams, 1986)."""
        w = self.field.weights
        joined, first, second, _ = part.layers
        hidden, features = samples.hidden[part.kept], samples.features[part.kept]
        by_second = by_colors @ w[4].T
        kernels.limit_change(by_second, second)
        by_first = by_second @ w[3].T
        kernels.limit_change(by_first, first)
        by_said = by_first @ w[2][:SAID].T
        by_said[:, 0] += by_raw
        by_hidden = by_said @ w[1].T
        kernels.limit_change(by_hidden, hidden)
        by_weights = (
            features.T @ by_hidden,
            hidden.T @ by_said,
            joined.T @ by_first,
            first.T @ by_second,
            second.T @ by_colors,
        )
        return by_hidden @ w[0].T, by_weights

    def _move(self, parts: list[Marched], rate: float) -> None:
        """Add up derivatives in the order of the rays, with one thread per level, and take an Adam step."""
        field = self.field
        for n, gradient in enumerate(self._gradient[1:]):
            for part in parts:
                gradient += part.by_weights[n]

        def move_level(level: int, _stop: int, _chunk: int) -> None:
            for part in parts:
                kernels.spread(part.positions, field.cells, level, part.by_features, self._gradient[0][level])
            self._adam(0, field.tables[level], rate * TABLE_RATE, level)

        _parallel.map_chunks(move_level, LEVELS, LEVELS)
        for n, one in enumerate(field.weights):
            self._adam(n + 1, one, rate * LAYER_RATE, slice(None))

    def _adam(self, n: int, values: np.ndarray, rate: float, at: int | slice) -> None:
        parts = (values, self._gradient[n][at], self._mean[n][at], self._square[n][at])
        move_touched(*(part.reshape(-1) for part in parts), np.float32(rate), NO_BIAS)

    def _update_occupancy(self) -> None:
        """Query the density in some cells, and mark cells empty whose alpha has been low for long."""
        part = self.num_steps // CHECK_EVERY % NUM_PARTS
        chosen = np.arange(part, len(self._may_be), NUM_PARTS)
        room = self.field.room
        positions = np.zeros((len(chosen), 4), np.float32)
        positions[:, :3] = self._may_be[chosen] + self._rng.random((len(chosen), 3), np.float32)
        positions[:, :3] *= np.float32((1.0 - 1e-6) / max(room.occupied.shape))

        def check(a: int, b: int, _: int) -> np.ndarray:
            said = query_density(self.field, positions[a:b])[2]
            raw = np.minimum(said[:, 0] + kernels.SHIFT, kernels.LARGEST_RAW)
            return 1.0 - np.exp(-np.exp(raw) * DELTA)

        alpha = np.concatenate(_parallel.map_chunks(check, len(chosen), -(-len(chosen) // SAMPLES)))
        self._alpha[chosen] = np.maximum(FADE * self._alpha[chosen], alpha)
        if self.num_steps < WARM_UP or part:
            return
        least = min(LEAST_ALPHA, float(self._alpha.mean()))
        occupied = np.zeros(room.occupied.shape, bool)
        occupied[tuple(self._may_be[self._alpha >= least].astype(np.int64).T)] = True
        self.field = self.field._replace(
            room=room._replace(occupied=occupied.astype(np.uint8), blocks=blocks_of(occupied))
        )

    def _wanted(self, chosen: np.ndarray) -> np.ndarray:
        """(n, 3) colors of pixels over the background."""
        rgba = self.rays.pixels[chosen].astype(np.float32) / np.float32(255.0)
        alpha = rgba[:, 3:]
        return rgba[:, :3] * alpha + (np.float32(1.0) - alpha) * self.background

    def __len__(self) -> int:
        """Number of parameters."""
        return self.field.tables.size + sum(one.size for one in self.field.weights)

    @checked
    def render(self, view: TrainingView) -> np.ndarray:
        """(h, w, 3) render of a view."""
        return self.render_counted(view)[0]

    def render_counted(self, view: TrainingView) -> tuple[np.ndarray, int]:
        """(h, w, 3) render of a view, and the number of network queries."""
        image, _, count = render_hash(self.field, view.camera, view.cam_from_world, self.background)
        return image, count
