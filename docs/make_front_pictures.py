"""Generate the images of README.md from real data: `python docs/make_front_pictures.py` (three minutes on two cores).

The data folder is `$EPIPOLE_DATA`, or else ../shared/data next to the repository. The data sets are fountain-P11 (Strecha et al.,
CVPR 2008), Motorcycle (Scharstein et al., GCPR 2014) and 7-Scenes (Shotton et al., CVPR 2013).
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

import epipole
from epipole.disparity_search.search import match_stereo
from epipole.geometry import Rigid3
from epipole.image import color_map
from epipole.io import read_colmap_model, read_trajectory
from epipole.io.images.photographs import read_rgb
from epipole.pipelines.stereo.depth import depth_of
from epipole.scene import RectifiedRig
from epipole.synthetic import look_at

IMAGES = Path(__file__).with_name("pictures")
DATA = Path(os.environ.get("EPIPOLE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
FOUNTAIN = {"camera_model": "PINHOLE", "camera_params": "1379.74,1382.08,760.345,503.405"}
HELD_OUT = "0005.jpg"
WIDTH, HEIGHT = 640, 300
SUPERSAMPLING = 3
"""Factor by which images are rendered larger, then downscaled, for smooth edges."""
BACKGROUND_BGR = (24, 20, 17)
CAMERA_BGR = (60, 80, 230)


class View:
    """An image of points and lines in space."""

    def __init__(self, cam_from_world: Rigid3, focal_px: float) -> None:
        """Create an empty image with this pose."""
        self.image = np.full((SUPERSAMPLING * HEIGHT, SUPERSAMPLING * WIDTH, 3), BACKGROUND_BGR, np.uint8)
        self.cam_from_world, self.focal_px = cam_from_world, SUPERSAMPLING * focal_px

    @staticmethod
    def around(
        points_in_world: np.ndarray, toward_camera: np.ndarray, up: np.ndarray, focal_px: float
    ) -> View:
        """View from this direction, as close as possible with all points visible."""
        low, high = points_in_world.min(axis=0), points_in_world.max(axis=0)
        middle, direction = (low + high) / 2, toward_camera / np.linalg.norm(toward_camera)
        distance = 0.2 * float(np.linalg.norm(high - low))
        while True:
            view = View(look_at(middle + distance * direction, middle, up), focal_px)
            at, depth = view.pixels(points_in_world)
            if (
                (depth > 0).all()
                and (at >= 0).all()
                and (at < (SUPERSAMPLING * WIDTH, SUPERSAMPLING * HEIGHT)).all()
            ):
                return view
            distance *= 1.02

    def pixels(self, points_in_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Integer pixels, (n, 2), and depths."""
        x, y, z = self.cam_from_world.apply(points_in_world).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = self.focal_px * x / z, self.focal_px * y / z
        at = np.stack([u + SUPERSAMPLING * WIDTH / 2, v + SUPERSAMPLING * HEIGHT / 2], axis=1)
        return np.clip(np.nan_to_num(at, nan=-9999.0), -9999, 9999).astype(int), z

    def points(self, points_in_world: np.ndarray, rgb: np.ndarray, radius: int) -> None:
        """Plot points as discs, sorted from far to near."""
        at, depth = self.pixels(points_in_world)
        for n in np.argsort(-depth):
            if depth[n] > 0:
                color = tuple(int(c) for c in rgb[n][::-1])
                cv2.circle(self.image, tuple(at[n].tolist()), radius, color, -1, cv2.LINE_AA)

    def line(self, points_in_world: np.ndarray, color: tuple[int, int, int], width: int) -> None:
        """Plot a line through the points."""
        at, _ = self.pixels(points_in_world)
        cv2.polylines(self.image, [at.reshape(-1, 1, 2).astype(np.int32)], False, color, width, cv2.LINE_AA)

    def frustum(self, camera: epipole.Camera, cam_from_world: Rigid3, depth: float) -> None:
        """Plot the frustum of a camera."""
        w, h = camera.width - 0.5, camera.height - 0.5
        corners = (
            np.array([[-0.5, -0.5, 1], [w, -0.5, 1], [w, h, 1], [-0.5, h, 1]]) @ np.linalg.inv(camera.K).T
        )
        world = cam_from_world.inverse().apply(depth * np.vstack([np.zeros(3), corners]))
        self.line(world[[1, 2, 3, 4, 1]], CAMERA_BGR, 4)
        for corner in range(1, 5):
            self.line(world[[0, corner]], CAMERA_BGR, 3)

    def downscaled(self) -> np.ndarray:
        """Downscale the image to its final size."""
        return cv2.resize(self.image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def save(name: str, image: np.ndarray) -> None:
    """Write an image to docs/pictures/front_NAME.jpg."""
    path = IMAGES / f"front_{name}.jpg"
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 88])


def cropped(rgb: np.ndarray, width: int) -> np.ndarray:
    """Crop the center of an image to this width and the common height, and convert it to BGR."""
    scale = max(width / rgb.shape[1], HEIGHT / rgb.shape[0])
    size = (max(width, round(scale * rgb.shape[1])), max(HEIGHT, round(scale * rgb.shape[0])))
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    large = cv2.resize(rgb, size, interpolation=interpolation)
    left, top = (size[0] - width) // 2, (size[1] - HEIGHT) // 2
    return np.ascontiguousarray(large[top : top + HEIGHT, left : left + width, ::-1])


def model(work: Path) -> None:
    """Points and cameras of a reconstruction from eleven photographs."""
    found = epipole.reconstruct(DATA / "sfm/fountain-P11/images", work / "sfm", **FOUNTAIN).model
    cams_from_world, points = found.cams_from_world(), found.points
    centers = cams_from_world.centers()
    middle = np.median(points.xyz_in_world, axis=0)
    up, back = -cams_from_world.rotation[:, 1].mean(axis=0), centers.mean(axis=0) - middle
    distance = float(np.linalg.norm(back))
    near = np.linalg.norm(points.xyz_in_world - middle, axis=1) < 1.1 * distance
    side = np.cross(up, back) / np.linalg.norm(up)
    visible = np.vstack([middle + 0.4 * (points.xyz_in_world[near] - middle), centers])
    view = View.around(visible, back + 0.8 * side + 0.7 * distance * up, up, 700)
    view.points(points.xyz_in_world[near], points.rgb[near], 4)
    for image in range(len(found.images)):
        camera = found.cameras[int(found.camera_of_image[image])]
        view.frustum(camera, cams_from_world[image], 0.12 * distance)
    save("model", view.downscaled())


def stereo(_: Path) -> None:
    """Left image of a stereo pair and its depth: near is blue, far is red, unknown is black."""
    left, right = (read_rgb(DATA / f"stereo/motorcycle/motorcycle_{side}.png") for side in ("left", "right"))
    rig = RectifiedRig(
        focal_px=994.978, cx=311.193, cy=254.877, baseline=0.193001, principal_offset_px=31.086
    )
    depth = depth_of(match_stereo(left, right), rig).depth
    save("stereo", np.hstack([cropped(left, WIDTH // 2), cropped(color_map(depth), WIDTH // 2)]))


def slam(work: Path) -> None:
    """Trajectory of a handheld depth camera over its map, from above and behind."""
    epipole.slam(DATA / "slam/7scenes", work / "slam")
    poses = read_trajectory(work / "slam/trajectory.txt").world_from_body
    points = read_colmap_model(work / "slam/sparse/0").points
    middle, positions = np.median(points.xyz_in_world, axis=0), poses.translation
    up, back = -poses.rotation[:, :, 1].mean(axis=0), positions.mean(axis=0) - middle
    distances = np.linalg.norm(points.xyz_in_world - middle, axis=1)
    near = distances < np.percentile(distances, 75)
    view = View.around(
        np.vstack([points.xyz_in_world[near], positions]), back + 1.2 * np.linalg.norm(back) * up, up, 900
    )
    view.points(points.xyz_in_world, points.rgb, 4)
    colors = color_map(np.arange(len(positions), dtype=float))
    for n in range(len(positions) - 1):
        view.line(positions[n : n + 2], tuple(int(c) for c in colors[n][::-1]), 6)
    save("slam", view.downscaled())


def splat(work: Path) -> None:
    """Rendering of a held-out view, and its photograph."""
    epipole.splat(work / "sfm", work / "splat", time="60s", max_side_px=512, test=HELD_OUT)
    rendered = read_rgb(next((work / "splat/test").glob(f"{Path(HELD_OUT).stem}*.png")))
    truth = read_rgb(DATA / "sfm/fountain-P11/images" / HELD_OUT)
    save("splat", np.hstack([cropped(rendered, WIDTH // 2), cropped(truth, WIDTH // 2)]))


if __name__ == "__main__":
    requested = sys.argv[1:] or ["model", "stereo", "slam", "splat"]
    with tempfile.TemporaryDirectory(prefix="front") as folder:
        for make_image in (model, stereo, slam, splat):
            if make_image.__name__ in requested or (make_image is model and "splat" in requested):
                make_image(Path(folder))
