"""A path and its map on a viser server while they grow."""

from __future__ import annotations

import threading

import numpy as np
import viser
from jaxtyping import Float64, UInt8

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.scene import frustum_corners_in_cam
from epipole.viewer.live import LiveScene, frusta_pieces
from epipole.viewer.server import close_server

_PATH_RGB, _KEYFRAME_RGB, _NOW_RGB, _LOOP_RGB = (
    (31, 138, 176),
    (120, 180, 205),
    (240, 170, 40),
    (226, 62, 142),
)
_POINT_RGB = (110, 118, 124)
_KEYFRAME_SHARE, _NOW_SHARE, _POINT_SHARE = 0.05, 0.12, 0.004
"""Of the usual distance of the points from the camera."""
_VIEW_SHARE = np.array([-0.25, -0.9, -1.3])
"""Where the first view stands, beside, above and behind the first camera."""


class LiveViewer:
    """Points, keyframes and the path in the scene; picture, state and switches beside it."""

    def __init__(self, server: viser.ViserServer, camera: Camera) -> None:
        self.server = server
        self.stopped = threading.Event()
        self.corners_in_cam = frustum_corners_in_cam(camera.K, camera.width, camera.height)
        self.depth = 0.0
        self.with_view: set[int] = set()
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        self.words = gui.add_markdown("waiting for the first frame")
        self.counts = gui.add_markdown("")
        blank = np.zeros((max(1, 320 * camera.height // camera.width), 320, 3), np.uint8)
        self.picture = gui.add_image(blank, label="green: in the map", format="jpeg", jpeg_quality=70)
        self.follow = gui.add_checkbox("Follow the camera", initial_value=True)
        self.show_points = gui.add_checkbox("Points", initial_value=True)
        self.show_keyframes = gui.add_checkbox("Keyframes", initial_value=True)
        server.scene.set_up_direction("-y")

    def stop(self) -> None:
        """Close the server; again does nothing."""
        if not self.stopped.is_set():
            self.stopped.set()
            close_server(self.server)

    def show_picture(self, rgb: UInt8[np.ndarray, "h w 3"], words: str) -> None:
        """The picture of now, and what is known now."""
        with self.server.atomic():
            self.picture.image = rgb
            self.words.content = words

    def show_scene(self, scene: LiveScene) -> None:
        """Path and map of now, in the place of those shown before."""
        if not len(scene.places_in_world):
            return
        newest = scene.places_in_world[-1]
        if not self.depth and len(scene.points_in_world):
            self.depth = float(np.median(np.linalg.norm(scene.points_in_world - newest, axis=1)))
            self.server.initial_camera.near = 1e-3 * self.depth
            self.server.initial_camera.far = 1e3 * self.depth
        self._set_first_views(newest)
        size = self.depth or 1.0
        with self.server.atomic():
            self.counts.content = scene.words
            self._add_points(scene.points_in_world, size)
            keyframes = scene.world_from_keyframes
            if not self.show_keyframes.value:
                keyframes = keyframes[:0]
            self._add_lines(
                "/keyframes",
                frusta_pieces(keyframes, self.corners_in_cam, _KEYFRAME_SHARE * size),
                _KEYFRAME_RGB,
                1.0,
            )
            self._add_lines("/path", scene.path_in_world, _PATH_RGB, 3.0)
            self._add_lines("/loops", scene.loops_in_world, _LOOP_RGB, 3.0)

    def show_now(self, world_from_camera: Rigid3 | None) -> None:
        """The camera of now; None takes it away, where its place is not known."""
        if world_from_camera is None:
            self._add_lines("/now", np.zeros((0, 2, 3)), _NOW_RGB, 3.0)
            return
        one = Rigid3(world_from_camera.rotation[None], world_from_camera.translation[None])
        size = _NOW_SHARE * (self.depth or 1.0)
        self._add_lines("/now", frusta_pieces(one, self.corners_in_cam, size), _NOW_RGB, 3.0)
        self._move_views(world_from_camera.translation)

    def _add_points(self, points: Float64[np.ndarray, "n 3"], size: float) -> None:
        self.server.scene.add_point_cloud(
            "/points",
            points.astype(np.float32),
            _POINT_RGB,
            point_size=_POINT_SHARE * size,
            point_shape="rounded",
            precision="float32",
            visible=self.show_points.value,
        )

    def _add_lines(
        self, name: str, pieces: Float64[np.ndarray, "n 2 3"], rgb: tuple[int, int, int], thickness: float
    ) -> None:
        if not len(pieces):
            self.server.scene.remove_by_name(name)
            return
        self.server.scene.add_line_segments(
            name, pieces.astype(np.float32), rgb, thickness=thickness, thickness_units="screen"
        )

    def _set_first_views(self, place: Float64[np.ndarray, " 3"]) -> None:
        """Behind and above the camera, for each user once: they may come before the first points, or later."""
        for number, client in self.server.get_clients().items():
            if self.depth and number not in self.with_view:
                self.with_view.add(number)
                with client.atomic():
                    client.camera.position = place + self.depth * _VIEW_SHARE
                    client.camera.look_at = place

    def _move_views(self, place: Float64[np.ndarray, " 3"]) -> None:
        """Go along with the camera, from the side that each user has turned to."""
        if not self.depth or not self.follow.value:
            return
        for number, client in self.server.get_clients().items():
            if number not in self.with_view:
                continue
            aside = np.asarray(client.camera.position) - np.asarray(client.camera.look_at)
            with client.atomic():
                client.camera.position = place + aside
                client.camera.look_at = place
