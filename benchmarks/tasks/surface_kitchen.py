"""Color images of a kitchen (7-Scenes) with poses and points, and the depth images beside them in the color camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from epipole import reconstruct
from epipole.dense.source_selection import SharedPoints, depth_range, select_sources
from epipole.dense.view import DenseView
from epipole.geometry import Rigid3, Rotation3, align_points
from epipole.io.calibration.built_in import SEVEN_SCENES_DEPTH_SCALE, seven_scenes_cameras
from epipole.io.colmap.model import read_colmap_model
from epipole.io.images.photographs import read_rgb

FRAMES, JUDGED_EVERY = range(0, 320, 8), 2
"""Frames of the model, and the step between those whose depth is compared."""


@dataclass(frozen=True, slots=True, eq=False)
class Kitchen:
    """Views with their sources and ranges of depth; lengths are in meters."""

    frames: tuple[int, ...]
    published: Rigid3
    """cam_from_world from structure from motion over the whole room (Brachmann et al., ICCV 2021)."""
    own: Rigid3
    """The poses of epipole's model of these frames, aligned with the published positions."""
    sources: tuple[tuple[int, ...], ...]
    depths: tuple[tuple[float, float], ...]
    folder: Path

    def view(self, k: int, poses: Rigid3) -> DenseView:
        """A color image with its pose."""
        name = f"frame-{self.frames[k]:06d}.color.jpg"
        return DenseView(name, read_rgb(self.folder / name), seven_scenes_cameras()[0], poses[k])

    def measured(self, k: int) -> np.ndarray:
        """(h, w) depth image of a frame, registered to the color camera; NaN where the sensor has none."""
        return registered_depth(self.folder / f"frame-{self.frames[k]:06d}.depth.png")


def prepare_kitchen(work: Path, data: Path, num_sources: int) -> Kitchen:
    """Reconstruct the frames once, with the known camera; the model gives sources and ranges of depth."""
    folder = data / "slam" / "7scenes"
    camera = seven_scenes_cameras()[0]
    images, out = work / "kitchen" / "images", work / "kitchen" / "out"
    images.mkdir(parents=True, exist_ok=True)
    for frame in FRAMES:
        link = images / f"frame-{frame:06d}.color.jpg"
        if not link.exists():
            link.symlink_to((folder / link.name).resolve())
    if not (out / "sparse" / "0" / "cameras.bin").is_file():
        fx, fy, cx, cy = map(float, camera.params)
        reconstruct(images, out, camera_model="PINHOLE", camera_params=f"{fx},{fy},{cx + 0.5},{cy + 0.5}")
    model = read_colmap_model(out / "sparse" / "0")
    frames = tuple(int(name.split(".")[0].split("-")[1]) for name in model.images.name)
    order = np.argsort(frames)
    frames = tuple(frames[k] for k in order)
    published = published_poses(folder / "poses_sfm.txt", frames)
    model = model.transformed(align_points(model.camera_centers_in_world()[order], published.centers()))
    row_of_image = np.argsort(order)
    point = model.tracks.point_of_observation().astype(np.int64)
    shared = SharedPoints(model.points.xyz_in_world, row_of_image[model.tracks.image].astype(np.int64), point)
    own = model.cams_from_world()[order]
    sources = select_sources(shared, own.centers(), np.full(len(frames), camera.focal_px), num_sources)
    depths = []
    for k in range(len(frames)):
        seen = shared.points_in_world[point[shared.view_of_observation == k]]
        depths.append(depth_range(own[k].apply(seen)[:, 2]) or (0.5, 5.0))
    rows = tuple(tuple(row.tolist()) for row in sources)
    return Kitchen(frames, published, own, rows, tuple(depths), folder)


def published_poses(path: Path, frames: tuple[int, ...]) -> Rigid3:
    """cam_from_world of frames, from a file of TUM rows whose times are frame numbers."""
    table = np.loadtxt(path)
    rows = table[np.searchsorted(table[:, 0], np.array(frames))]
    assert np.array_equal(rows[:, 0], np.array(frames))
    return Rigid3(Rotation3.from_quat_wxyz(rows[:, [7, 4, 5, 6]]).matrix, rows[:, 1:4].copy()).inverse()


def registered_depth(path: Path) -> np.ndarray:
    """(h, w) depth image in the color camera, in meters; NaN where the sensor has none.

    7-Scenes publishes neither the pose of the depth camera nor the color camera's focal length: both, and the scale of the depth, are those that
    `epipole slam` uses (`seven_scenes_cameras`), which were estimated on this kitchen.
    """
    color, sensor, depth_from_color = seven_scenes_cameras()
    raw = np.asarray(Image.open(path)).astype(np.float64)
    v, u = np.nonzero((raw > 0) & (raw < 65535))
    rays = sensor.unproject(np.stack([u, v], axis=1).astype(np.float64))
    in_sensor = rays / rays[:, 2:] * (raw[v, u, None] / SEVEN_SCENES_DEPTH_SCALE)
    in_color = depth_from_color.inverse().apply(in_sensor)
    at = np.rint(color.project(in_color)).astype(np.int64)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < color.width) & (at[:, 1] < color.height)
    out = np.full((color.height, color.width), np.inf)
    np.minimum.at(out, (at[inside, 1], at[inside, 0]), in_color[inside, 2])
    return np.where(np.isfinite(out), out, np.nan)
