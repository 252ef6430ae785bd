"""The run in the browser while it goes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from epipole.pipelines.slam.config import JobOptions
from epipole.pipelines.slam.frames import Frame, TrackedFrame
from epipole.pipelines.slam.output.drawing import FINAL_RGB, path_curve
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.sources.folder import FrameSource
from epipole.viewer.live import Budget, LiveScene, picture_with_points
from epipole.viewer.live_server import opened_live

if TYPE_CHECKING:
    from epipole.viewer.live_viewer import LiveViewer

PICTURE_SHARE, SCENE_SHARE = 0.04, 0.05
"""Of the run's time, at most, for picture and state, and for path and map."""
PICTURE_PAUSE_S, SCENE_PAUSE_S = 0.04, 0.3


class LiveView:
    """Shows nothing: what a run without a viewer has."""

    def show(self, system: Slam, frame: Frame, answer: TrackedFrame) -> None:
        """A frame was followed."""


class BrowserView(LiveView):
    """Shows the run, as often as a tenth of its time allows."""

    def __init__(self, viewer: LiveViewer, num_frames: int) -> None:
        self.viewer, self.num_frames, self.count = viewer, num_frames, 0
        self.pictures, self.scenes = (
            Budget(PICTURE_SHARE, PICTURE_PAUSE_S),
            Budget(SCENE_SHARE, SCENE_PAUSE_S),
        )

    def show(self, system: Slam, frame: Frame, answer: TrackedFrame) -> None:
        """Picture and state, path and map, each if its share of the time allows."""
        self.count += 1
        words = _words(f"frame {self.count} of {self.num_frames}", answer)
        if self.pictures.allows():
            begin = perf_counter()
            now = system.snapshot()
            self.viewer.show_picture(
                picture_with_points(frame.grey, now.tracked_px, now.is_triangulated), words
            )
            self.viewer.show_now(answer.world_from_body)
            self.pictures.spend(perf_counter() - begin)
        if self.scenes.allows():
            begin = perf_counter()
            self.viewer.show_scene(_scene(system))
            self.scenes.spend(perf_counter() - begin)


@contextmanager
def open_live(source: FrameSource, job: JobOptions) -> Iterator[LiveView]:
    """What shows the run: a viewer in the browser, whose address is printed, or nothing.

    Raises:
        ConfigError: the port is in use or out of range.
    """
    if not job.view:
        yield LiveView()
        return
    from epipole.viewer.live_viewer import LiveViewer

    with opened_live(lambda server: LiveViewer(server, source.camera.camera), job.host, job.port) as viewer:
        yield BrowserView(viewer, source.num_frames)


def _words(first: str, answer: TrackedFrame) -> str:
    reason = f": {answer.reason}" if answer.reason else ""
    return f"**{answer.state.value}**{reason}  \n{first}, {answer.num_points} points"


def _scene(system: Slam) -> LiveScene:
    now, path = system.snapshot(), system.trajectory()
    num_keyframes = len(now.world_from_keyframes.translation)
    counts = f"{num_keyframes} keyframes, {len(now.points_in_world):,} points in the map"
    return LiveScene(
        counts,
        path.world_from_body.translation,
        path_curve("path", path, FINAL_RGB).segments_in_world,
        now.world_from_keyframes,
        now.points_in_world,
        _loop_pieces(system),
    )


def _loop_pieces(system: Slam) -> np.ndarray:
    """(l, 2, 3) between the keyframes of accepted loops."""
    center = {k.number: k.cam_from_world.inverse().translation for k in system.map.keyframes}
    pieces = [
        (center[loop.frame], center[loop.keyframe])
        for loop in system.loops
        if loop.verdict == "accepted" and loop.frame in center and loop.keyframe in center
    ]
    return np.array(pieces, np.float64).reshape(-1, 2, 3)
