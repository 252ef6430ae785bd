"""Rendered images with exact depth and poses, as COLMAP models that `epipole surface` reads.

Images are written once; a complete folder is reused. The points of the models are pixels of the exact depth that other views really see.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from benchmarks.tasks.surface_scenes import PLANS
from epipole.cameras import Camera
from epipole.dense.source_selection import SharedPoints, depth_range, select_sources
from epipole.dense.view import DenseView
from epipole.geometry import Rigid3
from epipole.io.colmap.model import write_colmap_model
from epipole.io.images.photographs import read_rgb
from epipole.io.images.rgba import write_png
from epipole.scene import Reconstruction
from epipole.synthetic import render

SIZE, FOCAL_35MM = (1536, 1024), 28.0
NOISE_GRAY = 1.5
"""Standard deviation of the sensor noise, in gray levels of 255."""
POINTS_PER_VIEW, LEAST_VIEWS, POINT_NOISE_PX = 500, 3, 0.3
"""Points of the model that each view contributes, fewest views of a point, and the noise of its observations."""
WIDEST_DEG = 50.0
"""Largest angle between two observations of a point: features are not matched beyond."""
SAME_SURFACE = 0.005
"""Largest difference of inverse depths, relative to them, of one surface in two views."""
COPY_DISTANCE_M = 1000.0
NUM_SOURCES = 5


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceScene:
    """Images and exact depth on disk; arrays are in the order of `names`."""

    name: str
    folder: Path
    """COLMAP model in sparse/0, images in images, exact depth in depth."""
    names: tuple[str, ...]
    camera: Camera
    cams_from_world: Rigid3

    def depth(self, k: int) -> np.ndarray:
        """(h, w) exact depth of a view; NaN for the sky."""
        return _array_of(self.folder / "depth" / f"{Path(self.names[k]).stem}.npz", "depth")

    def is_thin(self, k: int) -> np.ndarray:
        """Mask of the pixels that show thin things."""
        return _array_of(self.folder / "depth" / f"{Path(self.names[k]).stem}.npz", "is_thin")

    def view(self, k: int) -> DenseView:
        """Image, camera and pose of a view."""
        rgb = read_rgb(self.folder / "images" / self.names[k])
        return DenseView(self.names[k], rgb, self.camera, self.cams_from_world[k])

    def points(self, k: int, stride: int = 1) -> np.ndarray:
        """(h, w, 3) exact world position of each stride-th pixel; NaN for the sky."""
        z = self.depth(k)[::stride, ::stride].astype(np.float64)
        v, u = np.mgrid[: self.camera.height : stride, : self.camera.width : stride]
        (fx, _, cx), (_, fy, cy), _ = self.camera.K
        rays = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)
        return np.asarray(self.cams_from_world[k].inverse().apply(rays.reshape(-1, 3)).reshape(rays.shape))

    def is_visible(self, points: np.ndarray, k: int) -> np.ndarray:
        """(h, w) whether a view sees world positions (h, w, 3), by its exact depth."""
        in_cam = self.cams_from_world[k].apply(points.reshape(-1, 3)).reshape(points.shape)
        z, K = in_cam[..., 2], self.camera.K
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = K[0, 0] * in_cam[..., 0] / z + K[0, 2], K[1, 1] * in_cam[..., 1] / z + K[1, 2]
            inside = (
                (z > 0) & (u >= 0) & (v >= 0) & (u <= self.camera.width - 1) & (v <= self.camera.height - 1)
            )
            u, v = (np.where(inside, value, -9.0).astype(np.float32) for value in (u, v))
            known = np.nan_to_num(1.0 / self.depth(k)).astype(np.float32)
            out = np.zeros(z.shape, bool)
            for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST):  # exact on planes; right at edges
                there = cv2.remap(known, u, v, how, None, cv2.BORDER_CONSTANT, 0)
                out |= np.abs(there * z - 1.0) <= SAME_SURFACE
        return out & inside

    def num_seeing(self, k: int, others: Sequence[int], stride: int = 1) -> np.ndarray:
        """(h, w) number of other views that see each stride-th pixel of a view."""
        points = self.points(k, stride)
        return np.sum([self.is_visible(points, j) for j in others if j != k], axis=0, dtype=np.int64)

    def part(self, rows: Sequence[int]) -> SurfaceScene:
        """The same scene with some of its views."""
        names = tuple(self.names[k] for k in rows)
        return replace(self, names=names, cams_from_world=self.cams_from_world[list(rows)])


@lru_cache(maxsize=40)
def _array_of(path: Path, name: str) -> np.ndarray:
    with np.load(path) as stored:
        return np.asarray(stored[name])


def prepare_scene(
    name: str, work: Path, size: tuple[int, int] = SIZE, most: int | None = None
) -> SurfaceScene:
    """Render a scene of `PLANS` to a folder below `work`, unless it is there.

    Args:
        name: the scene.
        work: folder of all scenes.
        size: width and height of the images.
        most: number of views, the first ones; None: all.
    """
    plan = PLANS[name]()
    poses = plan.cams_from_world[: len(plan.cams_from_world) if most is None else most]
    focal = FOCAL_35MM / 36.0 * size[0]
    camera = Camera("PINHOLE", *size, [focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2])
    at = work / f"{name.replace(' ', '_')}_{size[0]}_{len(poses)}"
    names = tuple(f"view_{k:03d}.png" for k in range(len(poses)))
    scene = SurfaceScene(name, at, names, camera, poses)
    if (at / "sparse" / "0" / "cameras.bin").is_file():  # written last
        return scene
    for folder in ("images", "depth"):
        (at / folder).mkdir(parents=True, exist_ok=True)
    for k, file in enumerate(names):
        image = render(plan.scene, camera, poses[k], noise_sigma=NOISE_GRAY, seed=k)
        write_png(at / "images" / file, image.rgb)
        is_thin = np.zeros(image.depth.shape, bool)
        if plan.behind is not None:
            is_thin = (
                image.depth < np.nan_to_num(render(plan.behind, camera, poses[k]).depth, nan=np.inf) - 1e-6
            )
        depth = image.depth.astype(np.float32)
        np.savez(at / "depth" / f"{Path(file).stem}.npz", depth=depth, is_thin=is_thin)
    write_colmap_model(model_of(scene), at / "sparse" / "0")
    return scene


def model_of(scene: SurfaceScene) -> Reconstruction:
    """A model with exact poses and points, and with noise on the observations."""
    rng = np.random.default_rng(11)
    points, image, point, pixels = [], [], [], []
    centers, number = scene.cams_from_world.centers(), 0
    for k in range(len(scene.names)):
        z = scene.depth(k)
        v, u = np.nonzero(np.isfinite(z))
        chosen = rng.choice(len(u), POINTS_PER_VIEW, replace=False)
        rays = scene.camera.unproject(np.stack([u[chosen], v[chosen]], axis=1).astype(np.float64))
        in_cam = rays / rays[:, 2:] * z[v[chosen], u[chosen], None]
        xyz = scene.cams_from_world[k].inverse().apply(in_cam)
        seen = [scene.is_visible(xyz[None], j)[0] for j in range(len(scene.names))]
        toward = (centers[:, None] - xyz) / np.linalg.norm(centers[:, None] - xyz, axis=2, keepdims=True)
        near = (toward * toward[k]).sum(axis=2) >= np.cos(np.deg2rad(WIDEST_DEG))
        kept = np.array(seen) & near
        kept = kept[:, kept.sum(axis=0) >= LEAST_VIEWS], xyz[kept.sum(axis=0) >= LEAST_VIEWS]
        for j in range(len(scene.names)):
            rows = np.flatnonzero(kept[0][j])
            pixels.append(scene.camera.project(scene.cams_from_world[j].apply(kept[1][rows])))
            image.append(np.full(len(rows), j))
            point.append(number + rows)
        points.append(kept[1])
        number += len(kept[1])
    exact = np.concatenate(pixels)
    return Reconstruction.from_observations(
        scene.cams_from_world,
        scene.camera,
        np.concatenate(points),
        np.concatenate(image),
        np.concatenate(point),
        exact + POINT_NOISE_PX * rng.normal(size=exact.shape),
        scene.names,
    )


def write_part(scene: SurfaceScene, folder: Path) -> Path:
    """Write the views of a scene (see `SurfaceScene.part`) as a separate model with links to its images."""
    if not (folder / "sparse" / "0" / "cameras.bin").is_file():
        (folder / "images").mkdir(parents=True, exist_ok=True)
        for name in scene.names:
            _link(scene.folder / "images" / name, folder / "images" / name)
        write_colmap_model(model_of(scene), folder / "sparse" / "0")
    return folder


def write_copies(scene: SurfaceScene, count: int, folder: Path) -> Path:
    """Write `count` images that repeat those of a scene, each repetition far from the others in the world."""
    model, views = model_of(scene), len(scene.names)
    track = model.tracks.point_of_observation().astype(np.int64)
    pixels, n = model.observed_pixels(), len(model.points)
    copies = -(-count // views)
    poses, names, points, image, point = [], [], [], [], []
    for c in range(copies):
        shift = np.array([COPY_DISTANCE_M * c, 0.0, 0.0])
        motion = scene.cams_from_world
        poses.append(Rigid3(motion.rotation, motion.translation - motion.rotation @ shift))
        names += [f"copy_{c:03d}_{name}" for name in scene.names]
        points.append(model.points.xyz_in_world + shift)
        image.append(model.tracks.image.astype(np.int64) + c * views)
        point.append(track + c * n)
    rows, number = np.concatenate(image), np.concatenate(point)
    kept = rows < count
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names[:count]):
        _link(scene.folder / "images" / scene.names[k % views], folder / "images" / name)
    stacked = Rigid3(
        *(np.concatenate([getattr(p, a) for p in poses])[:count] for a in ("rotation", "translation"))
    )
    written = Reconstruction.from_observations(
        stacked,
        scene.camera,
        np.concatenate(points),
        rows[kept],
        number[kept],
        np.tile(pixels, (copies, 1))[kept],
        names[:count],
    )
    write_colmap_model(written, folder / "sparse" / "0")
    return folder


def _link(source: Path, target: Path) -> None:
    target.unlink(missing_ok=True)
    os.link(source, target)


def sources_of(
    scene: SurfaceScene, most: int = NUM_SOURCES
) -> tuple[list[list[int]], list[tuple[float, float]]]:
    """Sources and range of depth of each view, as `epipole surface` selects them."""
    model = model_of(scene)
    point = model.tracks.point_of_observation().astype(np.int64)
    shared = SharedPoints(model.points.xyz_in_world, model.tracks.image.astype(np.int64), point)
    focals = np.full(len(scene.names), scene.camera.focal_px)
    sources = select_sources(shared, scene.cams_from_world.centers(), focals, most)
    ranges = []
    for k in range(len(scene.names)):
        own = shared.points_in_world[point[shared.view_of_observation == k]]
        found = depth_range(scene.cams_from_world[k].apply(own)[:, 2])
        assert found is not None
        ranges.append(found)
    return [row.tolist() for row in sources], ranges
