"""A live page during a job, and a limit on how often the job may update it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from epipole.report.space_scene import SpaceScene
from epipole.screen import open_console
from epipole.viewer.handle import serve
from epipole.viewer.live_stream import LiveStream, scene_bytes
from epipole.viewer.page_server import PageServer, Served
from epipole.viewer.ports import note_on_port, port_for
from epipole.viewer.viewer import scene_pages


@dataclass(frozen=True, slots=True, kw_only=True)
class LivePage:
    """How a live page differs from that of a finished scene."""

    job: str
    """Name of the job in the page."""
    image_caption: str = ""
    """Caption of the current image; empty: there is no image."""
    has_camera: bool = False
    """Whether the state has a current camera `camera` (edges of its frustum, in the last curve) and `position`."""
    has_views: bool = False
    """Whether the job renders views at `live/view`."""
    pages: Mapping[str, Served] = field(default_factory=dict)
    """Additional pages by address."""


class LiveScene:
    """The scene of an open live page."""

    def __init__(self, stream: LiveStream, origin_in_world: np.ndarray) -> None:
        self._stream, self._origin = stream, origin_in_world
        self.meanwhile: Callable[[], object] = lambda: None
        """Called while tabs fetch the final state."""

    @property
    def is_watched(self) -> bool:
        """Whether a tab is open."""
        return self._stream.is_watched

    def publish(
        self,
        state: Mapping[str, Any],
        make_scene: Callable[[], SpaceScene] | None = None,
        **parts: Callable[[], bytes],
    ) -> None:
        """Publish a new state.

        Args:
            state: `state` and `words` of the page, the `fraction` of the job that is done, the current `camera`.
            make_scene: makes the scene, with the layers that the page was opened with, in a server thread; None:
                unchanged.
            parts: as in `LiveStream.publish`.
        """
        if make_scene is not None:
            parts["scene"] = lambda: scene_bytes(make_scene(), self._origin)
        self._stream.publish(state, **parts)


@contextmanager
def opened_live(page: LivePage, scene: SpaceScene, host: str, port: int | None) -> Iterator[LiveScene]:
    """Open a live page and print its address. At the end of the block it shows the final state, and its server stops.

    Args:
        page: how it differs from the page of a finished scene.
        scene: the initial scene.
        host: the address to listen on.
        port: the port to listen on; None: as chosen by `port_for`.

    Raises:
        ConfigError: the port is in use or out of range, or the host is not an address of this machine.
    """
    chosen, stream = port_for(host, port), LiveStream()
    names = ("image_caption", "has_camera", "has_views")
    given = {"run": stream.run_id, **{name: getattr(page, name) for name in names}}
    pages, origin = scene_pages(scene, given)
    server = PageServer({**pages, **stream.pages(), **page.pages}, host, chosen)
    handle = serve(server, server.port, host, note_on_port(port, server.port), block=False)
    noted = f" ({handle.note})" if handle.note else ""
    open_console(stderr=True).print(f"Live view at {handle.url}{noted}", highlight=False)
    view, ended = LiveScene(stream, origin), f"The {page.job} stopped with an error. This is the last state."
    try:
        yield view
        ended = f"The {page.job} has ended. This is the final state."
    finally:
        stream.end(ended, view.meanwhile)
        handle.stop()


class Budget:
    """Limits updates of a view to a fraction of the time since the start."""

    def __init__(self, fraction: float, pause_s: float) -> None:
        self.fraction, self.pause_s = fraction, pause_s
        self.spent_s = self._cost_s = 0.0
        self._start_s = perf_counter()
        self._last_s = -np.inf

    def allows(self) -> bool:
        """Whether the next update, if as long as the last one, would stay within the limit."""
        now = perf_counter()
        within = self.spent_s + self._cost_s <= self.fraction * (now - self._start_s)
        return within and now - self._last_s >= self.pause_s

    def spend(self, seconds: float) -> None:
        """Record the duration of an update."""
        self._cost_s, self._last_s = seconds, perf_counter()
        self.spent_s += seconds
