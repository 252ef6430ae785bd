"""Live view of a training in the browser."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from epipole._jit import compile_seconds
from epipole.cameras import Camera
from epipole.fields.splat.trainer import SplatTrainer
from epipole.fields.trainer import Trainer
from epipole.fields.training_view import TrainingView
from epipole.geometry import Rigid3
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.images import FieldImages
from epipole.pipelines.fields.scene import UNIT, cameras_of, first_view_of
from epipole.report.gaussians import most_visible
from epipole.report.space_scene import FirstView, SpaceScene
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.viewer.live import Budget, LivePage, LiveScene, opened_live
from epipole.viewer.page_server import JPEG, Served
from epipole.viewer.requested_views import RequestedViews

FRACTION = 0.08
"""Fraction of the training time spent on the live view, at most."""
PAUSE_S = 0.25
"""Shortest time between two updates."""
SPLAT_PAUSE_S = 1.0
"""The same for Gaussians: without a GPU, a browser needs 45 ms to show even a new word above a large view."""
MOST_GAUSSIANS = 60_000
"""Gaussians of an update, at most: 2.6 MB."""


class Watch:
    """Does nothing: for trainings without a live view."""

    def show(self, trainer: Trainer, fraction: float) -> None:
        """Called after each step, with the fraction of the training that is done."""


class BrowserWatch(Watch):
    """Shows the field, as often as its time budget allows.

    Gaussians are sent to the page, which renders them. Other fields are rendered here, for the viewpoint of each tab.
    """

    def __init__(self, page: LiveScene, views: RequestedViews, scene: SpaceScene) -> None:
        self.page, self.views, self.scene = page, views, scene
        pause_s = PAUSE_S if scene.gaussians is None else SPLAT_PAUSE_S
        self.budget, self.words_budget, self.fraction = (
            Budget(FRACTION, pause_s),
            Budget(FRACTION, pause_s),
            0.0,
        )

    def show(self, trainer: Trainer, fraction: float) -> None:
        """Update the page, if a tab is open and the budget allows it."""
        self.fraction = min(fraction, 1.0)
        if not self.page.is_watched:
            return
        if self.budget.allows():
            self._spend(self.budget, lambda: self.show_field(trainer))
        if self.words_budget.allows():
            self._spend(self.words_budget, lambda: self.page.publish(self._state(trainer)))

    def show_field(self, trainer: Trainer) -> None:
        """Send the current Gaussians, or one of the views that tabs wait for."""
        if isinstance(trainer, SplatTrainer):
            cloud = trainer.cloud
            self.page.publish(self._state(trainer), lambda: replace(self.scene, gaussians=_bounded(cloud)))
        else:
            self.render_next(trainer)

    def _state(self, trainer: Trainer) -> dict[str, Any]:
        words = f"step {trainer.num_steps:,}, {round(100 * self.fraction)} % of the training"
        if isinstance(trainer, SplatTrainer):
            words += f", {len(trainer):,} Gaussians"
        return {"state": "Running", "words": words, "fraction": self.fraction}

    def _spend(self, budget: Budget, act: Callable[[], object]) -> None:
        """Charge the budget with the time of a call, without kernel compilation, which happens once."""
        start, compiling = perf_counter(), compile_seconds()
        act()
        budget.spend(perf_counter() - start - (compile_seconds() - compiling))

    def render_next(self, trainer: Trainer) -> bool:
        """Render the view of a field that has waited longest, if any."""

        def render(camera: Camera, cam_from_world: Rigid3) -> np.ndarray:
            blank = np.zeros((camera.height, camera.width, 3), np.uint8)
            return trainer.render(TrainingView("watched", blank, camera, cam_from_world))

        return self.views.render_next(render)


@contextmanager
def open_watch(wanted: FieldOptions, images: FieldImages, trainer: Trainer, name: str) -> Iterator[Watch]:
    """Open the live view of a training, whose address is printed, or a watch that does nothing.

    Raises:
        ConfigError: the port is in use or out of range.
    """
    if not wanted.view:
        yield Watch()
        return
    is_splat, views = isinstance(trainer, SplatTrainer), RequestedViews()
    own = {} if is_splat else {"live/view": Served(JPEG, views.answer)}
    live = LivePage(job="training", has_views=not is_splat, pages=own)
    scene = _scene(images, trainer, f"{name}: training")
    with opened_live(live, scene, wanted.host, wanted.port) as page:
        watch = BrowserWatch(page, views, scene)
        page.meanwhile = lambda: watch.render_next(trainer)
        yield watch
        watch.show_field(trainer)


def _scene(images: FieldImages, trainer: Trainer, title: str) -> SpaceScene:
    """Cameras, and the current Gaussians if there are any."""
    view = first_view_of(_centers_of(images), images.train)
    return SpaceScene(
        title=title,
        words="",
        unit=UNIT,
        cameras=cameras_of(images.train),
        gaussians=_bounded(trainer.cloud) if isinstance(trainer, SplatTrainer) else None,
        view=FirstView(*(np.array(view[name]) for name in ("position", "look_at", "up"))),
        background=float(trainer.background[0]),
    )


def _bounded(cloud: GaussianCloud) -> GaussianCloud:
    return cloud.rows(most_visible(cloud, MOST_GAUSSIANS))


def _centers_of(images: FieldImages) -> np.ndarray:
    """Known points; if there are none, the center of the cameras."""
    points = images.points_in_world[np.isfinite(images.points_in_world).all(axis=1)]
    if len(points):
        return points
    return np.mean([view.cam_from_world.inverse().translation for view in images.train], axis=0)[None]
