"""Gaussians learnt from pictures, step by step (Kerbl et al. 2023), in a schedule of sizes and counts (Chen et al., DashGaussian, 2025)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from epipole import _parallel
from epipole.errors import ConfigError, ShapeError
from epipole.fields import _adam_kernels as adam_kernels
from epipole.fields.config import SplatConfig
from epipole.fields.growth import Growth, halves
from epipole.fields.photometric import likeness
from epipole.fields.rasterizer import (
    CHUNK,
    Cloud,
    CloudGradient,
    RenderOptions,
    arrays_of,
    blend,
    gradient_of,
    tiles_of,
    view_of,
)
from epipole.fields.training_view import TrainingView
from epipole.scene.gaussian_cloud import NUM_SH, GaussianCloud

SIZES = ((0.10, 4), (0.35, 2), (1.0, 1))
"""Pictures are so many times smaller until that share of the training."""
DEGREES = ((0.10, 0), (0.25, 1), (0.45, 2), (1.0, 3))
"""Degree of the harmonics until that share."""
GROWN, CHANGES = 0.6, 40
"""Share after which no Gaussian is split any more, and how often some are until then."""
PLACE_RATES = (3e-3, 1e-4)
"""Of places at the begin and the end, in the scene's size a step."""
LAST_RATES = 0.3
"""What is left of the other rates at the end."""
RATES = {"log_scales": 2e-2, "quats_wxyz": 8e-3, "logits": 6e-2, "sh": 8e-3}
"""A step, of all but places; those of harmonics above degree 0 are a share of that."""
HIGHER_SH = 0.4
USUAL_MOST = 50_000
LEAST_SIDE_PX = 24
"""Of the smallest pictures."""


class SplatTrainer:
    """Trains Gaussians on views; the same views, start and steps give the same Gaussians for any number of threads.

    Attributes:
        config: options.
        cloud: the Gaussians as they are.
        num_steps: taken.
        loss: of the last step.
    """

    def __init__(
        self, views: Sequence[TrainingView], start: GaussianCloud, config: SplatConfig, background: np.ndarray
    ) -> None:
        """Begin.

        Args:
            views: pictures and cameras.
            start: the first Gaussians; more than `max_gaussians` (None: 50,000) are thinned out.
            config: options.
            background: (3,) colour behind everything.

        Raises:
            ConfigError: there is no view.
            ShapeError: there is no Gaussian.
        """
        if not views:
            raise ConfigError("there is no picture to train on")
        if not len(start):
            raise ShapeError("there is no Gaussian to begin with")
        self.config, self.views, self.num_steps, self.loss = config, list(views), 0, np.nan
        self.background = background.astype(np.float32)
        self.options = RenderOptions(antialiased=config.antialiased)
        self._rng = np.random.default_rng([20, config.seed])
        self._most = USUAL_MOST if config.max_gaussians is None else config.max_gaussians
        if len(start) > self._most:
            kept = np.sort(self._rng.choice(len(start), self._most, replace=False))
            start = start.rows(kept)
        self._arrays = arrays_of(start.rows(np.arange(len(start))))
        self._num_first = len(start)
        self._size = _size_of(self._arrays.means)
        self._means = Cloud(*(np.zeros_like(part) for part in self._arrays))
        self._squares = Cloud(*(np.zeros_like(part) for part in self._arrays))
        self._growth, self._num_changes = Growth(len(start)), 0
        self._order: list[int] = []
        self._smaller: dict[tuple[int, int], TrainingView] = {}

    @property
    def cloud(self) -> GaussianCloud:
        """The Gaussians as they are now."""
        return GaussianCloud(*(part.copy() for part in self._arrays))

    def __len__(self) -> int:
        return len(self._arrays.means)

    def step(self, progress: float) -> float:
        """One picture: draw it, compare, and move what was seen; returns the loss.

        Args:
            progress: share of the training that is done, from 0 to 1; sizes, counts and rates follow it.
        """
        self._raise_degree(progress)
        seen_view = self._next_view(progress)
        view = view_of(seen_view.camera, seen_view.cam_from_world, self.options)
        drawn = blend(tiles_of(self._arrays, view), view)
        found = likeness(
            drawn.over(self.background), seen_view.over(self.background), self.config.ssim_weight
        )
        by_coverage = -(found.by_picture @ self.background)
        gradient, _ = gradient_of(self._arrays, view, drawn, found.by_picture, None, by_coverage)
        rows = drawn.tiles.gaussian
        self._move(gradient, rows, progress)
        self._growth.add(gradient, rows, view.width)
        self.num_steps += 1
        if progress < GROWN and progress * CHANGES / GROWN >= self._num_changes + 1:
            self._num_changes = int(progress * CHANGES / GROWN)
            self._change(progress)
        self.loss = found.loss
        return found.loss

    def _next_view(self, progress: float) -> TrainingView:
        """Each view once, in an order that is drawn anew each time, in the size of the schedule."""
        if not self._order:
            self._order = self._rng.permutation(len(self.views)).tolist()
        number = self._order.pop()
        factor, camera = _until(SIZES, progress), self.views[number].camera
        while factor > 1 and min(camera.width, camera.height) // factor < LEAST_SIDE_PX:
            factor //= 2
        if (number, factor) not in self._smaller:
            self._smaller[number, factor] = self.views[number].smaller(factor)
        return self._smaller[number, factor]

    def _raise_degree(self, progress: float) -> None:
        wanted = NUM_SH[min(_until(DEGREES, progress), self.config.sh_degree)]
        have = self._arrays.sh.shape[1]
        if have < wanted:
            self._arrays, self._means, self._squares = (
                one._replace(
                    sh=np.concatenate([one.sh, np.zeros((len(one.sh), wanted - have, 3), np.float32)], axis=1)
                )
                for one in (self._arrays, self._means, self._squares)
            )

    def _move(self, gradient: CloudGradient, rows: np.ndarray, progress: float) -> None:
        """Adam, with rates that fall."""
        count = self.num_steps + 1
        unbias = 1.0 / (1.0 - np.array([adam_kernels.MOMENTUM, adam_kernels.SQUARES], np.float64) ** count)
        is_seen = np.zeros(len(self), np.bool_)
        is_seen[rows] = True
        fallen = LAST_RATES**progress
        place = self._size * PLACE_RATES[0] * (PLACE_RATES[1] / PLACE_RATES[0]) ** progress
        for name in Cloud._fields:
            values = _flat(getattr(self._arrays, name))
            rates = np.full(values.shape[1], place if name == "means" else fallen * RATES[name])
            if name == "sh":
                rates[3:] *= HIGHER_SH
            parts = [values, *(_flat(getattr(one, name)) for one in (gradient, self._means, self._squares))]
            _adam(parts, is_seen, rates.astype(np.float32), unbias.astype(np.float32))

    def _change(self, progress: float) -> None:
        """Split where pictures pull, up to the count of the schedule, and drop what is not seen."""
        share = min(1.0, progress / GROWN)
        wanted = self._num_first + (self._most - self._num_first) * share
        rows, stays = self._growth.changes(self._arrays, int(wanted))
        first, second = halves(self._arrays, rows)
        for part, half in zip(self._arrays, first):
            part[rows] = half
        none = Cloud(*(np.zeros_like(part) for part in second))
        for one in (self._means, self._squares):
            for part in one:
                part[rows] = 0.0
        kept = [Cloud(*(part[stays] for part in one)) for one in (self._arrays, self._means, self._squares)]
        self._arrays, self._means, self._squares = (
            Cloud(*(np.concatenate(pair) for pair in zip(one, more)))
            for one, more in zip(kept, (second, none, none))
        )
        self._growth = Growth(len(self))


def _adam(parts: Sequence[np.ndarray], is_seen: np.ndarray, rates: np.ndarray, unbias: np.ndarray) -> None:
    """Move rows of values (n, k) by their gradient, with Adam's mean and square."""

    def move(start: int, stop: int, _: int) -> None:
        adam_kernels.adam_rows(*parts, is_seen, start, stop, rates, unbias)

    _parallel.map_chunks(move, len(is_seen), max(1, len(is_seen) // CHUNK))


def _until(table: Sequence[tuple[float, int]], progress: float) -> int:
    return next((value for end, value in table if progress < end), table[-1][1])


def _flat(array: np.ndarray) -> np.ndarray:
    return array.reshape(len(array), -1)


def _size_of(means: np.ndarray) -> float:
    """Of the scene: median distance of the first Gaussians from their middle."""
    return float(np.median(np.linalg.norm(means - np.median(means, axis=0), axis=1)))
