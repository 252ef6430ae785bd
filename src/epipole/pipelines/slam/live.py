"""The run in the browser while it goes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from epipole.pipelines.slam.config import WatchOptions
from epipole.pipelines.slam.frames import Frame, TrackedFrame
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.source import FrameSource


class LiveView:
    """Shows nothing: what a run without a viewer has."""

    def show(self, system: Slam, frame: Frame, answer: TrackedFrame) -> None:
        """A frame was followed."""

    def finish(self, system: Slam) -> None:
        """The map is final."""


@contextmanager
def open_live(source: FrameSource, watch: WatchOptions) -> Iterator[LiveView]:
    """The viewer."""
    yield LiveView()
