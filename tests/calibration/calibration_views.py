"""Views of a board by made-up cameras, with exact truth."""

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.features.boards import BoardView, corners_on_board
from epipole.geometry import Rigid3, Rotation3

LENS = Camera(CameraModel.OPENCV, 640, 480, np.array([520.0, 524.0, 315.0, 236.0, -0.25, 0.08, 1e-3, -5e-4]))
OTHER = Camera(CameraModel.OPENCV, 640, 480, np.array([540.0, 538.0, 326.0, 245.0, -0.2, 0.05, 0.0, 1e-3]))
FISHEYE = Camera(
    CameraModel.OPENCV_FISHEYE, 640, 480, np.array([230.0, 231.0, 318.0, 242.0, 0.02, -0.01, 0.003, -0.001])
)
RIGHT_FROM_LEFT = Rigid3.exp(np.array([-0.12, 0.002, 0.004, 0.01, -0.03, 0.005]))


def board_places(rng, count, distance=(0.35, 0.9), spread=0.5, tilt=0.6):
    """cam_from_board of a board about 20 cm wide before a camera, tilted to all sides."""
    positions = []
    for _ in range(count):
        z = rng.uniform(*distance)
        at = np.array([rng.uniform(-spread, spread) * z, rng.uniform(-spread, spread) * z * 0.75, z])
        rotation = Rotation3.exp(rng.uniform(-tilt, tilt, 3)).matrix
        positions.append(Rigid3(rotation, at - rotation @ np.array([0.1, 0.06, 0.0])))
    return positions


def views_of(cameras, cam_from_rig, positions, board, rng, noise_px=0.1, shape=None):
    """[camera][view], corners outside an image left out."""
    points = corners_on_board(board) if shape is None else shape
    out = []
    for camera, position in zip(cameras, cam_from_rig):
        own = []
        for rig_from_board in positions:
            pixels = camera.project((position @ rig_from_board).apply(points))
            pixels = pixels + noise_px * rng.standard_normal(pixels.shape)
            inside = np.isfinite(pixels).all(axis=1) & (pixels > 0).all(axis=1)
            inside &= (pixels < [camera.width - 1, camera.height - 1]).all(axis=1)
            rows = np.flatnonzero(inside)
            if len(rows) < 12:
                rows = rows[:0]
            own.append(BoardView(rows, pixels[rows]))
        out.append(own)
    return out
