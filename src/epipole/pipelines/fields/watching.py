"""A training that is watched: pictures for whoever looks, for at most a tenth of its time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from epipole.cameras import Camera
from epipole.fields.training_view import TrainingView
from epipole.geometry import Rigid3
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.pictures import FieldPictures
from epipole.pipelines.fields.scene import first_view_of
from epipole.viewer.live import Budget
from epipole.viewer.live_server import opened_live

if TYPE_CHECKING:
    from epipole.viewer.field_watch import FieldWatch

SHARE, PAUSE_S = 0.1, 0.1
"""Of the time, for pictures, and the shortest time between two."""


@runtime_checkable
class Drawn(Protocol):
    """What is learnt, and can be drawn."""

    num_steps: int

    def draw(self, view: TrainingView) -> np.ndarray:
        """(h, w, 3) the picture of a view."""


class Watch:
    """Shows nothing: what a training without a viewer has."""

    def show(self, trainer: Drawn, share: float) -> None:
        """A step was taken, at a share of the training."""


class BrowserWatch(Watch):
    """Shows what is learnt, as often as its share of the time allows."""

    def __init__(self, viewer: FieldWatch) -> None:
        self.viewer, self.budget = viewer, Budget(SHARE, PAUSE_S)

    def show(self, trainer: Drawn, share: float) -> None:
        """A picture for everyone who looks."""
        if not self.budget.allows():
            return

        def draw(camera: Camera, cam_from_world: Rigid3) -> np.ndarray:
            blank = np.zeros((camera.height, camera.width, 3), np.uint8)
            return trainer.draw(TrainingView("watched", blank, camera, cam_from_world))

        begin = perf_counter()
        if self.viewer.show(draw, f"step {trainer.num_steps:,}, {round(100 * share)} % of the training"):
            self.budget.spend(perf_counter() - begin)


@contextmanager
def open_watch(wanted: FieldOptions, pictures: FieldPictures) -> Iterator[Watch]:
    """What shows the training: a viewer in the browser, whose address is printed, or nothing.

    Raises:
        ConfigError: the port is in use or out of range.
    """
    if not wanted.view:
        yield Watch()
        return
    from epipole.viewer.field_watch import FieldWatch

    told = first_view_of(_places_of(pictures), pictures.train)
    first = tuple(np.array(told[name]) for name in ("position", "look_at", "up"))
    with opened_live(lambda server: FieldWatch(server, first), wanted.host, wanted.port) as viewer:
        yield BrowserWatch(viewer)


def _places_of(pictures: FieldPictures) -> np.ndarray:
    """Known points, or where none are, what the first camera looks at from where the others stand."""
    points = pictures.points_in_world[np.isfinite(pictures.points_in_world).all(axis=1)]
    if len(points):
        return points
    return np.mean([view.cam_from_world.inverse().translation for view in pictures.train], axis=0)[None]
