"""Small models shared by the tests: one with a rig and an unregistered frame, and a plain one."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks, unregistered

NUM_POINTS = 25


def make_cameras() -> Cameras:
    return Cameras.from_list(
        [
            Camera(CameraModel.SIMPLE_RADIAL, 640, 480, np.array([500.0, 310.0, 245.0, 0.03])),
            Camera(
                CameraModel.OPENCV, 800, 600, np.array([610.0, 605.0, 401.5, 297.0, 0.02, -0.01, 1e-3, -2e-3])
            ),
            Camera(CameraModel.PINHOLE, 320, 240, np.array([260.0, 261.0, 159.5, 119.5])),
        ]
    )


def look_at_origin(centers: np.ndarray, rng: np.random.Generator) -> Rigid3:
    """cam_from_world of cameras that look at the origin, with a little roll."""
    z = -centers / np.linalg.norm(centers, axis=1, keepdims=True)
    x = np.cross(rng.normal(size=3) * 0.2 + np.array([0.0, 1.0, 0.0]), z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    return Rigid3(rotation, -(rotation @ centers[..., None])[..., 0])


def small_model(seed: int = 0) -> Reconstruction:
    """Two cameras on a rig (frames 0, 1, 2), a single camera (frames 3, 4 and the unregistered 5)."""
    rng = np.random.default_rng(seed)
    cameras = make_cameras()
    second_from_first = Rigid3.exp([0.2, 0.01, -0.02, 0.01, 0.05, -0.02])
    cam_from_rig = Rigid3(
        np.stack([np.eye(3), second_from_first.rotation, np.eye(3)]),
        np.stack([np.zeros(3), second_from_first.translation, np.zeros(3)]),
    )
    rigs = Rigs(np.array([0, 2, 3], np.int32), np.array([0, 1, 2], np.int32), cam_from_rig)
    centers = np.array([[np.sin(a) * 4, 0.3 * a, -np.cos(a) * 4] for a in np.linspace(-0.6, 0.6, 5)])
    known, lost = look_at_origin(centers, rng), unregistered(1)
    rig_from_world = Rigid3(
        np.concatenate([known.rotation, lost.rotation]), np.concatenate([known.translation, lost.translation])
    )
    frames = Frames(np.array([0, 0, 0, 1, 1, 1], np.int32), rig_from_world, np.full(6, np.nan))
    frame = np.array([0, 0, 1, 1, 2, 2, 3, 4, 5], np.int32)
    sensor = np.array([0, 1, 0, 1, 0, 1, 2, 2, 2], np.int32)
    names = (
        "rig/a 0.jpg",
        "rig/b0.jpg",
        "a1.jpg",
        "b1.jpg",
        "a2.jpg",
        "b2.jpg",
        "straße.png",
        "c4.jpg",
        "c5.jpg",
    )
    xyz = rng.uniform(-0.7, 0.7, (NUM_POINTS, 3))
    cams_from_world = cam_from_rig[sensor] @ rig_from_world[frame]
    keypoints, seen = [], []
    for image in range(len(names)):
        clutter = rng.uniform(0, 200, (4, 2))
        if frame[image] == 5:
            keypoints.append(clutter)
            continue
        points = np.sort(rng.choice(NUM_POINTS, 15, replace=False))
        camera = cameras[int(rigs.sensor_camera[sensor[image]])]
        pixels = camera.project(cams_from_world[image].apply(xyz[points])) + rng.normal(0, 0.4, (15, 2))
        keypoints.append(np.concatenate([clutter, pixels]))
        seen += [(int(point), image, 4 + k) for k, point in enumerate(points)]
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
    images = Images(names, frame, sensor, offsets, np.concatenate(keypoints))
    table = np.array(sorted(seen), np.int64)
    track_offsets = np.concatenate([[0], np.cumsum(np.bincount(table[:, 0], minlength=NUM_POINTS))]).astype(
        np.int64
    )
    tracks = Tracks(track_offsets, table[:, 1].astype(np.int32), table[:, 2].astype(np.int32))
    points = Points(xyz, rng.integers(0, 256, (NUM_POINTS, 3)).astype(np.uint8), np.full(NUM_POINTS, np.nan))
    model = Reconstruction(cameras, rigs, frames, images, points, tracks)
    errors, point = model.reprojection_errors_px(), tracks.point_of_observation()
    error_px = np.bincount(point, errors, NUM_POINTS) / np.maximum(
        np.bincount(point, minlength=NUM_POINTS), 1
    )
    return replace(model, points=replace(points, error_px=error_px))


def mappable_model(num_images: int = 6, num_points: int = 200) -> Reconstruction:
    """Single-camera views that all see the same points, enough for a mapper to start from."""
    rng = np.random.default_rng(7)
    cameras = Cameras.from_list(
        [Camera(CameraModel.SIMPLE_RADIAL, 640, 480, np.array([550.0, 319.5, 239.5, 0.0]))]
    )
    angles = np.linspace(-0.5, 0.5, num_images)
    centers = np.stack([4 * np.sin(angles), 0.2 * np.cos(5 * angles), -4 * np.cos(angles)], axis=1)
    cams_from_world = look_at_origin(centers, rng)
    xyz = rng.uniform(-0.9, 0.9, (num_points, 3))
    keypoints = []
    for image in range(num_images):
        pixels = cameras[0].project(cams_from_world[image].apply(xyz)) + rng.normal(0, 0.1, (num_points, 2))
        keypoints.append(np.concatenate([rng.uniform(0, 400, (4, 2)), pixels]))
    per_image = num_points + 4
    images = Images(
        tuple(f"{i:03d}.jpg" for i in range(num_images)),
        np.arange(num_images, dtype=np.int32),
        np.zeros(num_images, np.int32),
        per_image * np.arange(num_images + 1, dtype=np.int64),
        np.concatenate(keypoints),
    )
    frames = Frames(np.zeros(num_images, np.int32), cams_from_world, np.full(num_images, np.nan))
    tracks = Tracks(
        num_images * np.arange(num_points + 1, dtype=np.int64),
        np.tile(np.arange(num_images, dtype=np.int32), num_points),
        np.repeat(np.arange(4, per_image, dtype=np.int32), num_images),
    )
    points = Points(xyz, np.zeros((num_points, 3), np.uint8), np.full(num_points, np.nan))
    return Reconstruction(cameras, Rigs.of_single_cameras(1), frames, images, points, tracks)


def write_gcp_list(path: Path, model: Reconstruction, num_control: int = 5, num_check: int = 2) -> None:
    """Points of a model as surveyed points in local coordinates, ten times as large; the last ones are check points."""
    lengths = np.diff(model.tracks.offsets)
    candidates = np.flatnonzero(lengths >= min(3, lengths.max()))
    chosen = [int(candidates[0])]
    xyz = model.points.xyz_in_world
    near = np.argsort(np.linalg.norm(xyz[candidates] - np.median(xyz[candidates], axis=0), axis=1))
    candidates = candidates[near[: max(len(near) * 3 // 4, num_control + num_check)]]
    while len(chosen) < num_control + num_check:  # farthest from those chosen
        distance = np.linalg.norm(xyz[candidates][:, None] - xyz[chosen], axis=2).min(axis=1)
        chosen.append(int(candidates[np.argmax(distance)]))
    lines = ["LOCAL"]
    for n, point in enumerate(chosen):
        name = f"P{n + 1}" if n < num_control else f"CHK-P{n + 1}"
        numbers = " ".join(f"{10.0 * value:.6f}" for value in xyz[point])
        for row in range(model.tracks.offsets[point], model.tracks.offsets[point + 1]):
            image = int(model.tracks.image[row])
            u, v = model.images.keypoints_of(image)[model.tracks.keypoint[row]]
            lines.append(f"{numbers} {u:.2f} {v:.2f} {model.images.name[image]} {name}")
    path.write_text("\n".join(lines) + "\n")
