"""Trainer for 3D Gaussians (Kerbl et al. 2023) with a schedule of resolutions and counts (DashGaussian, 2025)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from epipole._checks import check_fraction, checked
from epipole._checks.tables import Expected, Table, check_arrays
from epipole.errors import ConfigError, ShapeError
from epipole.fields.config import SplatTraining
from epipole.fields.exposure import Exposures
from epipole.fields.photometric import photometric_loss
from epipole.fields.point_depths import PointDepths, depth_loss, point_depths
from epipole.fields.pose_steps import PoseSteps
from epipole.fields.random_state import STATE, set_state, state_of
from epipole.fields.splat.gaussian_adam import GaussianAdam, Rates
from epipole.fields.splat.growing_cloud import GrowingCloud
from epipole.fields.splat.growth import Growth, split
from epipole.fields.splat.rasterizer import (
    Cloud,
    CloudGradient,
    ImageGradient,
    Rendering,
    RenderOptions,
    arrays_of,
    backward,
    render_view,
    view_of,
)
from epipole.fields.training_view import TrainingView
from epipole.scene.gaussian_cloud import DC, NUM_SH, GaussianCloud

SIZES = ((0.10, 4), (0.35, 2), (1.0, 1))
"""(fraction of the training until which it applies, downscaling factor of the images)."""
DEGREES = ((0.10, 0), (0.25, 1), (0.45, 2), (1.0, 3))
"""(fraction of the training until which it applies, degree of the harmonics)."""
GROWN = 0.6
"""Fraction of the training after which Gaussians are no longer split."""
CHANGES = 40
"""Number of times that Gaussians are split and removed until then."""
MEAN_RATE_BY_VIEW = 3e-5
"""Initial learning rate of positions per view, in scene sizes. Few views constrain positions weakly along their rays,
so a low rate keeps good initial positions: it gains 0.7 to 1.2 dB."""
MEAN_RATES = (3e-4, 3e-3)
"""Bounds of the initial learning rate of positions."""
MEAN_RATE_DECAY = 0.05
"""Factor of the learning rate of positions at the end."""
LAST_RATES = 0.3
"""Factor of the other learning rates at the end."""
RATES = (2e-2, 8e-3, 6e-2, 8e-3, 3.2e-3)
"""Initial learning rates of all but positions, in the order of `Rates`."""
DROPPED_BY = 0.5
"""Fraction of the training at which the dropout reaches its full rate."""
MOST_DROPPED, LEAST_DROPPED = 0.2, 0.05
"""Bounds of the dropout rate, 2 / number of views; below the lower one there is no dropout."""
USUAL_MOST = 50_000
LEAST_SIDE_PX = 24
"""Shorter side of downscaled images, at least."""


class SplatTrainer:
    """Trains Gaussians on views; the result does not depend on the number of threads.

    Attributes:
        config: options.
        cloud: current Gaussians.
        num_steps: steps taken.
        loss: loss of the last step.
    """

    @checked
    def __init__(
        self,
        views: Sequence[TrainingView],
        start: GaussianCloud,
        config: SplatTraining,
        background: Float32[np.ndarray, " 3"],
    ) -> None:
        """Set up a training.

        Args:
            views: images and cameras.
            start: initial Gaussians; a random subset if there are more than `max_gaussians` (None: 50,000).
            config: options.
            background: (3,) background color.

        Raises:
            ConfigError: there is no view.
            ShapeError: there is no Gaussian, or the background is not finite.
        """
        if not views:
            raise ConfigError("there is no image to train on")
        if not np.isfinite(background).all():
            raise ShapeError("background must be finite")
        if not len(start):
            raise ShapeError("start must have at least one Gaussian")
        self.config, self.views, self.num_steps, self.loss = config, list(views), 0, np.nan
        self.background = background
        self.options = RenderOptions(antialiased=config.antialiased)
        self._rng = np.random.default_rng([20, config.seed])
        self._most = USUAL_MOST if config.max_gaussians is None else config.max_gaussians
        if len(start) > self._most:
            kept = np.sort(self._rng.choice(len(start), self._most, replace=False))
            start = start.rows(kept)
        self._adam = GaussianAdam(arrays_of(start))
        self._set_arrays(arrays_of(start), self._adam.mean, self._adam.square)
        self._num_first = len(start)
        self._size = _size_of(self._arrays.means)
        dropped = min(MOST_DROPPED, 2.0 / len(self.views))
        self._drop = dropped if dropped >= LEAST_DROPPED else 0.0
        self._exposures = Exposures(len(self.views)) if config.exposure else None
        positions = [view.cam_from_world for view in self.views]
        self._poses = PoseSteps(positions, self._size) if config.refine_poses else None
        self._depths: dict[tuple[int, int], PointDepths] = {}
        self._growth, self._num_changes = Growth(len(start)), 0
        self._order: list[int] = []
        self._gradient: CloudGradient | None = None
        self._smaller: dict[tuple[int, int], TrainingView] = {}

    def _set_arrays(self, *clouds: Cloud) -> None:
        """Set values, first and second moments, with capacity for all Gaussians to come."""
        self._buffers = [GrowingCloud(cloud, self._most) for cloud in clouds]
        self._renew()

    def _renew(self) -> None:
        self._arrays, self._adam.mean, self._adam.square = (one.cloud for one in self._buffers)

    @property
    def cloud(self) -> GaussianCloud:
        """Copy of the current Gaussians."""
        return GaussianCloud(*(part.copy() for part in self._arrays))

    @property
    def field(self) -> GaussianCloud:
        """The same, by the name that all trainers share."""
        return self.cloud

    def __len__(self) -> int:
        return len(self._arrays.means)

    @property
    def table(self) -> Table:
        """Arrays of `state`."""
        axes = {"means": "n 3", "log_scales": "n 3", "quats_wxyz": "n 4", "logits": "n", "sh": "n s 3"}
        parts = {
            f"{kind}_{name}": Expected("float32", axes[name], least=0 if kind == "square" else None)
            for kind in ("value", "mean", "square")
            for name in Cloud._fields
        }
        return {
            **parts,
            "grad2d": Expected("float32", "n", least=0),
            "views": Expected("float32", "n", least=0),
            "order": Expected("int64", "_", least=0, most=len(self.views) - 1),
            "counts": Expected("int64", "3", least=0),
            "size": Expected("float64", least=0),
            "rng": STATE,
            **{name: one for part in self._own() for name, one in part.table.items()},
        }

    def state(self) -> dict[str, np.ndarray]:
        """All state that the next steps depend on, except the views."""
        clouds = {"value": self._arrays, "mean": self._adam.mean, "square": self._adam.square}
        counts = [self.num_steps, self._num_changes, self._num_first]
        return {
            **{
                f"{kind}_{name}": part for kind, one in clouds.items() for name, part in one._asdict().items()
            },
            "grad2d": self._growth.grad2d,
            "views": self._growth.views,
            "order": np.array(self._order, np.int64),
            "counts": np.array(counts, np.int64),
            "size": np.array(self._size),
            "rng": state_of(self._rng),
            **{name: value for part in self._own() for name, value in part.state().items()},
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state` of a trainer with the same views and options, with bit-identical results.

        Raises:
            ShapeError: the number of Gaussians, a rotation or the number of harmonics is invalid.
        """
        state = check_arrays(state, self.table)
        n, num_sh = state["value_sh"].shape[:2]
        most = max(self._most, self._num_first)
        if not 1 <= n <= most or num_sh not in NUM_SH[: self.config.sh_degree + 1]:
            raise ShapeError(
                f"value_sh must have 1 to {most} Gaussians of degree {self.config.sh_degree} or less, "
                f"got {state['value_sh'].shape}"
            )
        if not state["value_quats_wxyz"].any(axis=1).all():
            raise ShapeError("value_quats_wxyz must be rotations, but one is zero")
        if not 1 <= state["counts"][2] <= most:
            raise ShapeError(
                f"counts must have an initial number of Gaussians from 1 to {most}, got {state['counts'][2]}"
            )
        names = ("value", "mean", "square")
        self._set_arrays(*(Cloud(*(state[f"{name}_{part}"] for part in Cloud._fields)) for name in names))
        self._growth = Growth(len(self))
        self._growth.grad2d, self._growth.views = state["grad2d"], state["views"]
        self._order = state["order"].tolist()
        self.num_steps, self._num_changes, self._num_first = state["counts"].tolist()
        self._size = float(state["size"])
        set_state(self._rng, state["rng"])
        for part in self._own():
            part.restore(state)

    def _own(self) -> list[Exposures | PoseSteps]:
        """Optimizers of per-view parameters."""
        return [part for part in (self._exposures, self._poses) if part is not None]

    @property
    def posed_views(self) -> list[TrainingView]:
        """The views, with their current poses."""
        return [self._view(number, 1) for number in range(len(self.views))]

    @checked
    def render(self, view: TrainingView) -> np.ndarray:
        """(h, w, 3) render of a view."""
        return self.render_counted(view)[0]

    def render_counted(self, view: TrainingView) -> tuple[np.ndarray, int]:
        """(h, w, 3) render of a view, and the number of Gaussian-pixel pairs that were evaluated."""
        seen = view_of(view.camera, view.cam_from_world, self.options)
        rendered = render_view(self._arrays, seen)
        return rendered.over(self.background), rendered.num_evaluated

    @checked
    def step(self, progress: float) -> float:
        """Render one image, compare it, and update the visible Gaussians; returns the loss.

        Args:
            progress: fraction of the training that is done, which determines resolution, count and learning rates.

        Raises:
            ConfigError: progress is not from 0 to 1.
        """
        check_fraction(progress, "progress")
        self._raise_degree(progress)
        number = self._next_view()
        self.loss = self._learn(number, self._factor(number, progress), progress)
        self.num_steps += 1
        if self._exposures is not None and self.num_steps % len(self.views) == 0:
            self._take(self._exposures.taken_mean())
        if progress < GROWN and progress * CHANGES / GROWN >= self._num_changes + 1:
            self._num_changes = int(progress * CHANGES / GROWN)
            self._change(progress)
        return self.loss

    def _learn(self, number: int, factor: int, progress: float) -> float:
        """Update the Gaussians visible in a view, with images downscaled by `factor`; returns the loss."""
        of = self._view(number, factor)
        view = view_of(of.camera, of.cam_from_world, self.options)
        rendered = render_view(self._arrays, view, self._shown(progress))
        loss, by_color, by_coverage = self._compare(number, of, rendered, progress)
        depths = depth_loss(rendered, self._known(number, factor), self.config.depth_weight)
        found = backward(
            self._arrays,
            view,
            rendered,
            ImageGradient(by_color, depths.by_depth, by_coverage + depths.by_coverage),
            self._gradient,
        )
        self._gradient = found.cloud
        self._adam.step(
            self._arrays, found.cloud, found.is_visible, self._rates(progress), self.num_steps + 1
        )
        self._growth.add(found.cloud.center, found.is_visible, view.width)
        if self._poses is not None:
            self._poses.move(number, found.by_pose, progress)
        return loss + depths.loss

    def _compare(
        self, number: int, of: TrainingView, rendered: Rendering, progress: float
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Loss of a render on the used pixels, with the view's exposure, and derivatives w.r.t. color and coverage."""
        exposures, behind = self._exposures, self.background
        seen = rendered.over(behind) if exposures is None else exposures.applied(number, rendered, behind)
        truth = of.over(behind)
        if of.used_mask is not None:
            used = of.used_mask[..., None].astype(np.float32)
            seen, truth = seen * used, truth * used
        found = photometric_loss(seen, truth, self.config.ssim_weight)
        by_seen = found.by_image if of.used_mask is None else found.by_image * used
        if exposures is not None:
            return found.loss, *exposures.learn(number, rendered, behind, by_seen, progress)
        return found.loss, by_seen, -(by_seen @ behind) if behind.any() else np.zeros_like(rendered.coverage)

    def _take(self, colors: np.ndarray) -> None:
        """Apply a color transform [A b] to the Gaussians: 1/2 + DC sh_0 + ... becomes A (1/2 + DC sh_0 + ...) + b."""
        rotation, sh = colors[:, :3], self._arrays.sh
        sh[:] = sh @ rotation.T
        sh[:, 0] += (rotation.sum(axis=1) / 2 - 0.5 + colors[:, 3]) / np.float32(DC)

    def _next_view(self) -> int:
        """Next view; each epoch has a new random order."""
        if not self._order:
            self._order = self._rng.permutation(len(self.views)).tolist()
        return self._order.pop()

    def _factor(self, number: int, progress: float) -> int:
        """Downscaling factor of the schedule."""
        factor, camera = _until(SIZES, progress), self.views[number].camera
        while factor > 1 and min(camera.width, camera.height) // factor < LEAST_SIDE_PX:
            factor //= 2
        return factor

    def _view(self, number: int, factor: int) -> TrainingView:
        """A view, downscaled by `factor`, with its current pose."""
        if (number, factor) not in self._smaller:
            self._smaller[number, factor] = self.views[number].smaller(factor)
        view = self._smaller[number, factor]
        return (
            view if self._poses is None else replace(view, cam_from_world=self._poses.cams_from_world[number])
        )

    def _known(self, number: int, factor: int) -> PointDepths:
        """Depths of a view's points in the original pose of its camera."""
        if (number, factor) not in self._depths:
            view = self._smaller[number, factor]
            is_requested = self.config.depth_weight > 0
            self._depths[number, factor] = point_depths(
                view if is_requested else replace(view, points_in_world=None)
            )
        return self._depths[number, factor]

    def _shown(self, progress: float) -> np.ndarray | None:
        """Opacity factors that drop random Gaussians, so that all of them train (Park et al., DropGaussian, 2025).

        This reduces overfitting to few views: with 6 to 10 training views, held-out views gain 0.6 to 1.5 dB.
        """
        fraction = self._drop * min(1.0, progress / DROPPED_BY)
        if fraction == 0.0:
            return None
        kept = self._rng.random(len(self), np.float32) >= np.float32(fraction)
        return kept * np.float32(1.0 / (1.0 - fraction))

    def _raise_degree(self, progress: float) -> None:
        wanted = NUM_SH[min(_until(DEGREES, progress), self.config.sh_degree)]
        if self._arrays.sh.shape[1] < wanted:
            for one in self._buffers:
                one.raise_degree(wanted)
            self._renew()

    def _rates(self, progress: float) -> Rates:
        """Current learning rates; they decay, those of positions fastest."""
        fallen = LAST_RATES**progress
        first = min(max(MEAN_RATE_BY_VIEW * len(self.views), MEAN_RATES[0]), MEAN_RATES[1])
        position = self._size * first * MEAN_RATE_DECAY**progress
        return Rates(position, *(fallen * rate for rate in RATES))

    def _change(self, progress: float) -> None:
        """Split Gaussians with large image-space gradients, up to the scheduled count, and remove transparent ones."""
        fraction = min(1.0, progress / GROWN)
        wanted = self._num_first + (self._most - self._num_first) * fraction
        rows, stays = self._growth.changes(self._arrays, int(wanted))
        first, second = split(self._arrays, rows)
        for part, half in zip(self._arrays, first):
            part[rows] = half
        none = Cloud(*(np.zeros_like(part) for part in second))
        adam = self._adam
        for one in (adam.mean, adam.square):
            for part in one:
                part[rows] = 0.0
        gone = np.flatnonzero(~stays)
        for buffer, more in zip(self._buffers, (second, none, none)):
            buffer.change(gone, more)
        self._renew()
        self._growth = Growth(len(self))


def _until(table: Sequence[tuple[float, int]], progress: float) -> int:
    return next((value for end, value in table if progress < end), table[-1][1])


def _size_of(means: np.ndarray) -> float:
    """Scene size: median distance of the initial Gaussians from their center."""
    return float(np.median(np.linalg.norm(means - np.median(means, axis=0), axis=1)))
