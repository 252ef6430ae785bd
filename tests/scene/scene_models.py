"""A small model with a rig of two cameras, exact to rounding, and one frame that is not registered."""

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks, unregistered

CAMERAS = [
    Camera(CameraModel.OPENCV, 640, 480, np.array([500.0, 490.0, 320.0, 240.0, -0.1, 0.02, 1e-3, -1e-3])),
    Camera(CameraModel.SIMPLE_PINHOLE, 320, 240, np.array([260.0, 160.0, 120.0])),
    Camera(CameraModel.SIMPLE_RADIAL, 800, 600, np.array([700.0, 400.0, 300.0, 0.05])),
]


def rig_model(rng: np.random.Generator, num_points: int = 12) -> Reconstruction:
    """Frames 0 to 2 of rig 0 (cameras 0 and 1), frame 3 of rig 1 (camera 2), frame 4 unregistered (rig 1)."""
    cam_from_rig = Rigid3.exp([[0.0] * 6, [-0.2, 0.0, 0.05, 0.01, -0.1, 0.02], [0.0] * 6])
    rigs = Rigs(np.array([0, 2, 3], np.int32), np.array([0, 1, 2], np.int32), cam_from_rig)
    placed = Rigid3.exp(rng.normal([0, 0, 6, 0, 0, 0], [1, 1, 1, 0.1, 0.1, 0.1], (4, 6)))
    nowhere = unregistered(1)
    rig_from_world = Rigid3(
        np.concatenate([placed.rotation, nowhere.rotation]),
        np.concatenate([placed.translation, nowhere.translation]),
    )
    frames = Frames(
        np.array([0, 0, 0, 1, 1], np.int32), rig_from_world, np.array([0.0, 0.1, 0.2, np.nan, np.nan])
    )
    frame = np.array([0, 0, 1, 1, 2, 2, 3, 4], np.int32)
    sensor = np.array([0, 1, 0, 1, 0, 1, 2, 2], np.int32)
    points = rng.uniform(-1, 1, (num_points, 3))
    registered = 7
    keypoints = [
        CAMERAS[sensor[i]].project((cam_from_rig[sensor[i]] @ rig_from_world[frame[i]]).apply(points))
        for i in range(registered)
    ]
    keypoints.append(np.array([[1.0, 2.0], [3.0, 4.0]]))
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
    names = tuple(f"cam{s}/{f:03d}.jpg" for f, s in zip(frame, sensor))
    images = Images(names, frame, sensor, offsets, np.concatenate(keypoints))
    # Keypoint j of every registered image sees point j, but the last point is seen by images 0 and 6 alone.
    seen_by = [np.arange(registered)] * (num_points - 1) + [np.array([0, 6])]
    tracks = Tracks(
        np.concatenate([[0], np.cumsum([len(s) for s in seen_by])]).astype(np.int64),
        np.concatenate(seen_by).astype(np.int32),
        np.repeat(np.arange(num_points), [len(s) for s in seen_by]).astype(np.int32),
    )
    return Reconstruction(
        Cameras.from_list(CAMERAS),
        rigs,
        frames,
        images,
        Points(points, np.zeros((num_points, 3), np.uint8), np.zeros(num_points)),
        tracks,
    )


def empty_model() -> Reconstruction:
    """Nothing at all."""
    none = np.zeros(0, np.int32)
    return Reconstruction(
        Cameras.from_list([]),
        Rigs.of_single_cameras(0),
        Frames(none, unregistered(0), np.zeros(0)),
        Images((), none, none, np.zeros(1, np.int64), np.zeros((0, 2))),
        Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0)),
        Tracks(np.zeros(1, np.int64), none, none),
    )
