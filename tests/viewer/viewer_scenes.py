"""Things to look at, and what to look with."""

import socket
import urllib.request

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks

OPEN = urllib.request.build_opener(urllib.request.ProxyHandler({})).open
HOSTILE = "<img src=x onerror=alert(1)>.jpg"


def three_cameras(num_points: int = 5) -> Reconstruction:
    """Cameras at x = 0, 1, 2 that look along +y; the third is not registered. Points lie at y = 4."""
    rotation = np.broadcast_to(np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), (3, 3, 3)).copy()
    centers = np.array([[0.0, 0, 0], [1.0, 0, 0], [np.nan, 0, 0]])
    camera = Camera(CameraModel.SIMPLE_PINHOLE, 64, 48, np.array([50.0, 31.5, 23.5]))
    xyz = np.stack([np.linspace(-1, 2, num_points), np.full(num_points, 4.0), np.zeros(num_points)], axis=1)
    return Reconstruction(
        Cameras.from_list([camera]),
        Rigs.of_single_cameras(1),
        Frames(
            np.zeros(3, np.int32),
            Rigid3(rotation, -(rotation @ centers[:, :, None])[:, :, 0]),
            np.full(3, np.nan),
        ),
        Images(
            ("a.jpg", HOSTILE, "c.jpg"),
            np.arange(3, dtype=np.int32),
            np.zeros(3, np.int32),
            np.array([0, num_points, 2 * num_points, 2 * num_points]),
            np.zeros((2 * num_points, 2)),
        ),
        Points(xyz, np.full((num_points, 3), 90, np.uint8), np.linspace(0.2, 1.0, num_points)),
        Tracks(
            2 * np.arange(num_points + 1),
            np.tile(np.array([0, 1], np.int32), num_points),
            np.repeat(np.arange(num_points, dtype=np.int32), 2),
        ),
    )


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
