"""Rendered images of scenes in which different surfaces look the same, with exact cameras and depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.tasks.sfm import SfmTask, of_frames
from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.synthetic import SyntheticScene, render
from epipole.synthetic.look_alike import city_of_like_blocks, tiled_room

WIDTH, HEIGHT = 480, 360
FOCAL_PX = 300.0
NOISE_GRAY = 2.0
"""Standard deviation of the sensor noise, in gray levels of 255."""
DEPTH_TOLERANCE = 0.02
"""Relative difference of depth up to which a pixel and its projection in another image show the same point."""
STRIDE_PX = 4
"""Distance between the pixels that are projected into the other image."""

SCENES: dict[str, Callable[[int], tuple[SyntheticScene, Rigid3]]] = {
    "city": city_of_like_blocks,
    "tiled": tiled_room,
}


@dataclass(frozen=True, slots=True, eq=False)
class RenderedTask:
    """A task with everything that is known about its images; all arrays are in the order of `task.image_names`."""

    task: SfmTask
    camera: Camera
    cams_from_world: Rigid3
    depth: np.ndarray
    """(n, h, w) z in camera coordinates, in meters; NaN for the sky."""

    @property
    def size_m(self) -> float:
        """Size of the scene: the largest distance between two cameras."""
        centers = self.cams_from_world.centers()
        return float(np.linalg.norm(centers[:, None] - centers[None], axis=2).max())


def prepare_rendered(name: str, seed: int, work: Path) -> RenderedTask:
    """Render a scene of `SCENES` and write its images and true cameras under `work`."""
    scene, cams_from_world = SCENES[name](seed)
    center = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    camera = Camera(CameraModel.PINHOLE, WIDTH, HEIGHT, np.array([FOCAL_PX, FOCAL_PX, *center]))
    folder, frames, depths = work / "rendered", [], []
    folder.mkdir(parents=True, exist_ok=True)
    for k, cam_from_world in enumerate(cams_from_world):
        image = render(scene, camera, cam_from_world, noise_sigma=NOISE_GRAY, seed=k)
        file = folder / f"{name}{seed}_{k:02d}.png"
        cv2.imwrite(str(file), cv2.cvtColor(image.rgb, cv2.COLOR_RGB2BGR))
        world_from_cam = cam_from_world.inverse()
        pose = np.column_stack([world_from_cam.rotation, world_from_cam.translation])
        frames.append((file, pose))
        depths.append(image.depth)
    params = (FOCAL_PX, FOCAL_PX, center[0] + 0.5, center[1] + 0.5)
    task = of_frames(f"{name}{seed}", frames, params, work)
    return RenderedTask(task, camera, cams_from_world, np.stack(depths))


def project_into(scene: RenderedTask, i: int, j: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the surface points at pixels (n, 2) of image i are in image j: pixels (n, 2), and depth (n,) there, in meters.

    NaN where image i shows the sky, or the point is behind the camera.
    """
    last = np.array(scene.depth.shape[:0:-1]) - 1
    column, row = np.clip(np.rint(pixels).astype(int), 0, last).T
    rays = scene.camera.unproject(pixels)
    points_in_i = rays * (scene.depth[i, row, column] / rays[:, 2])[:, None]
    motion = scene.cams_from_world[j] @ scene.cams_from_world[i].inverse()
    points_in_j = motion.apply(points_in_i)
    points_in_j[~(points_in_j[:, 2] > 0.0)] = np.nan
    return scene.camera.project(points_in_j), points_in_j[:, 2]


def common_fraction(scene: RenderedTask, i: int, j: int) -> float:
    """Fraction of the pixels of image i whose surface point image j shows, by exact depth; the sky shows nothing."""
    height, width = scene.depth.shape[1:]
    grid = np.mgrid[0:height:STRIDE_PX, 0:width:STRIDE_PX].reshape(2, -1)[::-1].T.astype(np.float64)
    at, depth = project_into(scene, i, j, grid)
    inside = (at > -0.5).all(axis=1) & (at < (width - 0.5, height - 0.5)).all(axis=1)
    column, row = np.rint(at[inside]).astype(int).T
    seen = np.abs(scene.depth[j, row, column] / depth[inside] - 1.0) < DEPTH_TOLERANCE
    return float(seen.sum()) / len(grid)
