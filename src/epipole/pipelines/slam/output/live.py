"""Live view of a run in the browser."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from PIL import Image

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import JobOptions
from epipole.pipelines.slam.frames import Frame, TrackedFrame
from epipole.pipelines.slam.output.rendering import FINAL_RGB, LOOP_RGB, LOOPS, path_curve
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.snapshot import Snapshot
from epipole.report.markup import plural
from epipole.report.space_scene import METERS, NO_UNIT, CameraLayer, FirstView, PointLayer, SpaceScene
from epipole.scene import Curve, frustum_corners_in_cam
from epipole.viewer.live import Budget, LivePage, LiveScene, opened_live

FRACTION = 0.05
"""Largest fraction of the run time spent on copying data for the view."""
PAUSE_S = 0.4
"""Shortest time between two updates."""
IMAGE_WIDTH_PX = 480
LOCALIZED_RGB, WAITING_RGB = (60, 220, 110), (255, 170, 60)
POINT_RGB, NOW_RGB = (200, 200, 200), (240, 170, 40)
NOW_SIZE = 0.12
"""Size of the current camera, as a fraction of the median distance to the points."""
FROM_BEHIND = np.array([-0.25, -0.9, -1.3])
"""Initial viewpoint relative to the camera (beside, above and behind it), in median distances to the points."""
UP = np.array([0.0, -1.0, 0.0])
CAPTION = "Triangulated points are green, others orange"


class LiveView:
    """Shows nothing: the view of a run without a viewer."""

    def show(self, system: Slam, frame: Frame, answer: TrackedFrame) -> None:
        """Show a tracked frame."""

    def show_map(self, system: Slam, words: str) -> None:
        """Show the map after the last frame, or at the end of the run."""


class BrowserView(LiveView):
    """Shows the run in a web page.

    The run's thread copies the data, for at most `FRACTION` of its time; the server's threads encode it.
    """

    def __init__(self, page: LiveScene, num_frames: int) -> None:
        self.page, self.num_frames, self.count = page, num_frames, 0
        self.budget, self.depth = Budget(FRACTION, PAUSE_S), 0.0

    def show(self, system: Slam, frame: Frame, answer: TrackedFrame) -> None:
        """Publish image, state, trajectory and map, if a tab is open and the time budget allows it."""
        self.count += 1
        if not (self.page.is_watched and self.budget.allows()):
            return
        start, now = perf_counter(), system.snapshot()
        state = {
            "state": answer.state.value.capitalize() + (f": {answer.reason}" if answer.reason else ""),
            "words": f"frame {self.count} of {self.num_frames}, {plural(len(now.tracked_px), 'tracked point')}",
            "fraction": self.count / max(self.num_frames, self.count),
        }
        image = partial(image_with_points, frame.gray, now.tracked_px, now.is_triangulated)
        self._publish(system, now, state, answer.world_from_body, image=lambda: _jpeg(image()))
        self.budget.spend(perf_counter() - start)

    def show_map(self, system: Slam, words: str) -> None:
        """Publish trajectory and map, even if no tab is open yet."""
        path = system.trajectory().world_from_body
        newest = path[-1] if len(path.translation) else None
        state = {"state": words, "words": f"{self.count} frames", "fraction": None}
        self._publish(system, system.snapshot(), state, newest)

    def _publish(
        self,
        system: Slam,
        now: Snapshot,
        state: dict[str, Any],
        world_from_camera: Rigid3 | None,
        **parts: Any,
    ) -> None:
        path, loops, points = system.trajectory(), _loop_pieces(system), now.points_in_world
        newest = path.world_from_body.translation[-1] if len(path) else np.zeros(3)
        if not self.depth and len(points):
            self.depth = float(np.median(np.linalg.norm(points - newest, axis=1)))
        size = self.depth or 1.0
        num_keyframes = len(now.world_from_keyframes.translation)
        state["words"] += f"; map: {plural(num_keyframes, 'keyframe')}, {plural(len(points), 'point')}"
        state |= _camera(system.camera.camera, world_from_camera, NOW_SIZE * size)
        curves = (path_curve("trajectory", path, FINAL_RGB), Curve(LOOPS, loops, LOOP_RGB))
        view = _view(newest, size)
        self.page.publish(state, lambda: _scene(system, now, curves, view), **parts)


@contextmanager
def open_live(system: Slam, num_frames: int, job: JobOptions, name: str) -> Iterator[LiveView]:
    """Open the live view of a run and print its address; without `job.view`, a view that shows nothing.

    Raises:
        ConfigError: the port is in use or out of range.
    """
    if not job.view:
        yield LiveView()
        return
    first = _scene(system, system.snapshot(), (), _view(np.zeros(3), 1.0))
    first = replace(first, title=f"{name}: SLAM")
    live = LivePage(job="run", image_caption=CAPTION, has_camera=True)
    with opened_live(live, first, job.host, job.port) as page:
        view = BrowserView(page, num_frames)
        yield view
        view.show_map(system, "")


def image_with_points(
    gray: UInt8[np.ndarray, "h w"],
    pixels: Float64[np.ndarray, "n 2"],
    is_triangulated: Bool[np.ndarray, " n"],
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The image, `IMAGE_WIDTH_PX` wide, with triangulated points in green and others in orange."""
    scale = min(1.0, IMAGE_WIDTH_PX / gray.shape[1])
    size = (max(1, round(scale * gray.shape[1])), max(1, round(scale * gray.shape[0])))
    small = cv2.cvtColor(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2RGB)
    for (x, y), known in zip((pixels + 0.5) * scale - 0.5, is_triangulated):
        color = LOCALIZED_RGB if known else WAITING_RGB
        cv2.circle(small, (round(x), round(y)), 2, color, -1, cv2.LINE_AA)
    return small


def _jpeg(rgb: UInt8[np.ndarray, "h w 3"]) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(rgb).save(stream, "JPEG", quality=70)
    return stream.getvalue()


def _view(position: Float64[np.ndarray, " 3"], depth: float) -> FirstView:
    return FirstView(position + depth * FROM_BEHIND, position, UP)


def _camera(camera: Camera, world_from_camera: Rigid3 | None, size: float) -> dict[str, list[float] | None]:
    """Position and frustum edges of the current camera; None if its pose is unknown."""
    if world_from_camera is None:
        return {"position": None, "camera": None}
    corners_in_cam = frustum_corners_in_cam(camera.K, camera.width, camera.height)
    center, corners = world_from_camera.translation, world_from_camera.apply(size * corners_in_cam)
    centers = np.broadcast_to(center, (4, 3))
    edges = np.stack([np.stack([centers, corners], 1), np.stack([corners, np.roll(corners, -1, 0)], 1)])
    return {"position": center.tolist(), "camera": edges.ravel().tolist()}


def _scene(system: Slam, now: Snapshot, curves: tuple[Curve, ...], view: FirstView) -> SpaceScene:
    """Scene with the same layers at all times: without keyframes, one camera at the origin. The state has the current camera."""
    camera = system.camera.camera
    cams_from_world = now.world_from_keyframes.inverse()
    if not len(cams_from_world.translation):
        cams_from_world = Rigid3.identity(1)
    n, none = len(cams_from_world.translation), np.zeros((0, 2, 3))
    rgb = np.full((len(now.points_in_world), 3), POINT_RGB, np.uint8)
    keyframes = CameraLayer(
        "Keyframes",
        tuple(f"keyframe {k + 1}" for k in range(n)),
        cams_from_world,
        np.broadcast_to(camera.K, (n, 3, 3)).copy(),
        np.broadcast_to([camera.width, camera.height], (n, 2)).copy(),
    )
    path = curves or (Curve("trajectory", none, FINAL_RGB), Curve(LOOPS, none, LOOP_RGB))
    return SpaceScene(
        title="SLAM",
        words="",
        unit=METERS if system.camera.is_metric else NO_UNIT,
        points=(PointLayer("Points", now.points_in_world, rgb),),
        cameras=keyframes,
        curves=(*path, Curve("current camera", none, NOW_RGB)),
        view=view,
    )


def _loop_pieces(system: Slam) -> Float64[np.ndarray, "l 2 3"]:
    """Line segments between the keyframes of accepted loops."""
    center = {k.number: k.cam_from_world.inverse().translation for k in system.map.keyframes}
    pieces = [
        (center[loop.frame], center[loop.keyframe])
        for loop in system.loops
        if loop.verdict == "accepted" and loop.frame in center and loop.keyframe in center
    ]
    return np.array(pieces, np.float64).reshape(-1, 2, 3)
