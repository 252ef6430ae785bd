"""A field while it is learnt: drawn on this side, for the camera of each browser that looks."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from jaxtyping import Float32, Float64

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3, Rotation3
from epipole.viewer.server import close_server

SIDE_PX = 320
"""Height of the pictures: they are drawn between two steps."""
LEAST_ASPECT, MOST_ASPECT = 0.25, 4.0

Draw = Callable[[Camera, Rigid3], Float32[np.ndarray, "h w 3"]]


class FieldWatch:
    """Pictures behind everything, and what is known beside them."""

    def __init__(self, server: viser.ViserServer, first_view: tuple[Float64[np.ndarray, " 3"], ...]) -> None:
        """Begin at the position, what is looked at, and up of a first view."""
        position, look_at, up = first_view
        self.server, self.stopped = server, threading.Event()
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.words = server.gui.add_markdown("waiting for the first step")
        server.scene.set_up_direction(tuple(up.tolist()))
        camera, distance = server.initial_camera, float(np.linalg.norm(position - look_at))
        camera.position, camera.look_at = position, look_at
        camera.near, camera.far = 1e-2 * distance, 1e3 * distance

    def stop(self) -> None:
        """Close the server; again does nothing."""
        if not self.stopped.is_set():
            self.stopped.set()
            close_server(self.server)

    def show(self, draw: Draw, words: str) -> int:
        """Draw for everyone who looks; returns how many that were."""
        self.words.content = words
        clients = self.server.get_clients()
        for client in clients.values():
            camera, cam_from_world = camera_of(client.camera)
            picture = np.rint(255 * np.clip(draw(camera, cam_from_world), 0, 1)).astype(np.uint8)
            client.scene.set_background_image(picture, format="jpeg", jpeg_quality=80)
        return len(clients)


def camera_of(seen: Any) -> tuple[Camera, Rigid3]:
    """The pinhole camera at the place of viser's, whose axes are those of OpenCV."""
    aspect = float(np.clip(seen.aspect, LEAST_ASPECT, MOST_ASPECT))
    width, focal = max(1, round(aspect * SIDE_PX)), 0.5 * SIDE_PX / np.tan(0.5 * seen.fov)
    params = np.array([focal, focal, 0.5 * (width - 1), 0.5 * (SIDE_PX - 1)])
    rotation = Rotation3.from_quat_wxyz(np.asarray(seen.wxyz, np.float64)).matrix
    world_from_cam = Rigid3(rotation, np.asarray(seen.position, np.float64))
    return Camera(CameraModel.PINHOLE, width, SIDE_PX, params), world_from_cam.inverse()
