"""Rendered photographs of a drone that flies straight lines over hilly ground with houses, with exact poses and ground points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3
from epipole.io.images.photographs import write_jpeg_with_exif
from epipole.scene import Georeference
from epipole.synthetic import Box, HeightField, SyntheticScene, render

WIDTH, HEIGHT, FOCAL_35MM = 960, 720, 26.0
FOCAL_PX = FOCAL_35MM / 36.0 * WIDTH
DISTORTION = -0.03
ALTITUDE_M = 50.0
"""Above the mean ground: a pixel is 7 cm wide."""
ORIGIN = Georeference(48.2, 11.6, 520.0)
LINES, IMAGES_PER_LINE = 5, 7
FORWARD_OVERLAP, SIDE_OVERLAP = 0.75, 0.65
NOISE_GRAY, QUALITY = 2.0, 95
SAME_SURFACE_M = 0.05
"""Difference of depths up to which an image shows a point, rather than something before it."""


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """Images on disk, and the truth in meters east, north and up of `ORIGIN`."""

    images: Path
    names: tuple[str, ...]
    camera: Camera
    cams_from_world: Rigid3
    points: np.ndarray
    """(n, 3) points on the ground."""
    is_visible: np.ndarray
    """(images, n) whether an image shows a point."""


def prepare_flight(seed: int, folder: Path, gps_sigma_m: float = 2.0, num_points: int = 40) -> Flight:
    """Render a flight to a folder below `folder`, unless it is there; EXIF has GPS with noise."""
    at = folder / f"flight_{seed}"
    rng = np.random.default_rng(seed)
    camera = Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, [FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, DISTORTION])
    poses = poses_of(rng)
    scene = scene_around(rng, poses.centers())
    names = tuple(f"image_{k:03d}.jpg" for k in range(len(poses)))
    fixes = ORIGIN.lat_lon_alt_of(poses.centers() + gps_sigma_m * rng.normal(size=(len(poses), 3)))
    if not (at / "truth.npz").is_file():  # written last
        (at / "images").mkdir(parents=True, exist_ok=True)
        depth = []
        for k, name in enumerate(names):
            image = render(scene, camera, poses[k], noise_sigma=NOISE_GRAY, seed=k)
            depth.append(image.depth.astype(np.float32))
            gps = (float(fixes[k, 0]), float(fixes[k, 1]), float(fixes[k, 2]))
            path = at / "images" / name
            write_jpeg_with_exif(path, image.rgb, focal_35mm=FOCAL_35MM, gps=gps, quality=QUALITY)
        points, is_visible = _ground_points(camera, poses, depth, num_points, rng)
        np.savez(at / "truth.npz", points=points, is_visible=is_visible)
    with np.load(at / "truth.npz") as truth:
        return Flight(at / "images", names, camera, poses, truth["points"], truth["is_visible"])


def poses_of(rng: np.random.Generator) -> Rigid3:
    """Nadir images along lines in alternating directions, with the wobble of a gimbal."""
    step = (1.0 - FORWARD_OVERLAP) * HEIGHT / FOCAL_PX * ALTITUDE_M
    side = (1.0 - SIDE_OVERLAP) * WIDTH / FOCAL_PX * ALTITUDE_M
    rotations, centers = [], []
    for line in range(LINES):
        for k in range(IMAGES_PER_LINE):
            along = k if line % 2 == 0 else IMAGES_PER_LINE - 1 - k
            heading = 0.0 if line % 2 == 0 else np.pi
            # x of the camera to the right of the flight, y backward, z down.
            right, back = [np.cos(heading), -np.sin(heading), 0.0], [-np.sin(heading), -np.cos(heading), 0.0]
            down = np.array([right, back, [0.0, 0.0, -1.0]])
            rotations.append(Rotation3.exp(0.03 * rng.normal(size=3)).matrix @ down)
            centers.append([line * side, along * step, ALTITUDE_M] + rng.normal(size=3) * [0.5, 0.5, 0.8])
    rotation, center = np.array(rotations), np.array(centers)
    return Rigid3(rotation, -np.einsum("nij,nj->ni", rotation, center))


def scene_of(seed: int) -> SyntheticScene:
    """The ground and the houses of a flight."""
    rng = np.random.default_rng(seed)
    return scene_around(rng, poses_of(rng).centers())


def scene_around(rng: np.random.Generator, centers: np.ndarray) -> SyntheticScene:
    """Ground and houses below the positions of the cameras."""
    middle, half = centers.mean(axis=0), np.ptp(centers, axis=0) / 2 + 80.0
    seeds = iter(rng.integers(1, 1 << 20, 100).tolist())
    ground = HeightField(
        center=(float(middle[0]), float(middle[1]), 0.0),
        half_size=(float(half[0]), float(half[1])),
        amplitude=2.5,
        wavelength=70.0,
        color=(0.45, 0.5, 0.35),
        seed=next(seeds),
    )
    houses = [
        Box(
            center=(float(x), float(y), 1.5),
            half_size=(float(rng.uniform(3, 7)), float(rng.uniform(3, 7)), float(rng.uniform(3, 6))),
            angle_rad=float(rng.uniform(0, np.pi)),
            color=(0.6, 0.4, 0.35),
            seed=next(seeds),
        )
        for x, y in middle[:2] + rng.uniform(-1, 1, (14, 2)) * half[:2]
    ]
    return SyntheticScene.of([ground, *houses])


def _ground_points(
    camera: Camera, poses: Rigid3, depth: list[np.ndarray], count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points of the surface that at least four images show, and which images do."""
    points, visible = [], []
    while len(points) < count:
        k = int(rng.integers(len(poses)))
        u, v = int(rng.integers(30, camera.width - 30)), int(rng.integers(30, camera.height - 30))
        ray = camera.unproject(np.array([[float(u), float(v)]]))[0]
        point = poses[k].inverse().apply(ray / ray[2] * float(depth[k][v, u]))
        seen = np.array([_shows(camera, poses[i], depth[i], point) for i in range(len(poses))], bool)
        if seen.sum() >= 4:
            points.append(point)
            visible.append(seen)
    return np.array(points), np.array(visible).T


def _shows(camera: Camera, pose: Rigid3, depth: np.ndarray, point: np.ndarray) -> bool:
    in_cam = pose.apply(point)
    u, v = camera.project(in_cam[None])[0]
    if not (5 <= u < camera.width - 6 and 5 <= v < camera.height - 6):
        return False
    return bool(abs(float(depth[round(v), round(u)]) - in_cam[2]) < SAME_SURFACE_M * 4)
