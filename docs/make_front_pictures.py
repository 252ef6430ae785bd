"""Draw the images at the head of README.md: `python docs/make_front_pictures.py`, three minutes on two cores.

Everything in them was computed from real images of the data folder (`$EPIPOLE_DATA`, else ../shared/data beside the repository):
fountain-P11 (Strecha et al., CVPR 2008), Motorcycle (Scharstein et al., GCPR 2014), 7-Scenes (Shotton et al., CVPR 2013).
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
FINER = 3
"""Drawn so many times larger, and made smaller: smooth edges."""
BACK, CAMERAS = (24, 20, 17), (60, 80, 230)


class View:
    """An image into which points and lines of space are drawn."""

    def __init__(self, cam_from_world: Rigid3, focal_px: float) -> None:
        """An empty image seen from there."""
        self.image = np.full((FINER * HEIGHT, FINER * WIDTH, 3), BACK, np.uint8)
        self.cam_from_world, self.focal_px = cam_from_world, FINER * focal_px

    @staticmethod
    def around(points_in_world: np.ndarray, toward_eye: np.ndarray, up: np.ndarray, focal_px: float) -> View:
        """From that side, as near as all these points allow."""
        low, high = points_in_world.min(axis=0), points_in_world.max(axis=0)
        middle, direction = (low + high) / 2, toward_eye / np.linalg.norm(toward_eye)
        distance = 0.2 * float(np.linalg.norm(high - low))
        while True:
            view = View(look_at(middle + distance * direction, middle, up), focal_px)
            at, depth = view.pixels(points_in_world)
            if (depth > 0).all() and (at >= 0).all() and (at < (FINER * WIDTH, FINER * HEIGHT)).all():
                return view
            distance *= 1.02

    def pixels(self, points_in_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2) as whole numbers, and depths."""
        x, y, z = self.cam_from_world.apply(points_in_world).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = self.focal_px * x / z, self.focal_px * y / z
        at = np.stack([u + FINER * WIDTH / 2, v + FINER * HEIGHT / 2], axis=1)
        return np.clip(np.nan_to_num(at, nan=-9999.0), -9999, 9999).astype(int), z

    def points(self, points_in_world: np.ndarray, rgb: np.ndarray, radius: int) -> None:
        """Discs, the far ones first."""
        at, depth = self.pixels(points_in_world)
        for n in np.argsort(-depth):
            if depth[n] > 0:
                color = tuple(int(c) for c in rgb[n][::-1])
                cv2.circle(self.image, tuple(at[n].tolist()), radius, color, -1, cv2.LINE_AA)

    def path(self, points_in_world: np.ndarray, color: tuple[int, int, int], width: int) -> None:
        """A line through them."""
        at, _ = self.pixels(points_in_world)
        cv2.polylines(self.image, [at.reshape(-1, 1, 2).astype(np.int32)], False, color, width, cv2.LINE_AA)

    def frustum(self, camera: epipole.Camera, cam_from_world: Rigid3, depth: float) -> None:
        """The pyramid of a camera."""
        w, h = camera.width - 0.5, camera.height - 0.5
        corners = (
            np.array([[-0.5, -0.5, 1], [w, -0.5, 1], [w, h, 1], [-0.5, h, 1]]) @ np.linalg.inv(camera.K).T
        )
        world = cam_from_world.inverse().apply(depth * np.vstack([np.zeros(3), corners]))
        self.path(world[[1, 2, 3, 4, 1]], CAMERAS, 4)
        for corner in range(1, 5):
            self.path(world[[0, corner]], CAMERAS, 3)

    def small(self) -> np.ndarray:
        """The image in its size."""
        return cv2.resize(self.image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def save(name: str, image: np.ndarray) -> None:
    """As docs/pictures/front_NAME.jpg."""
    path = IMAGES / f"front_{name}.jpg"
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 88])


def filled(rgb: np.ndarray, width: int) -> np.ndarray:
    """The middle of an image, of this width and the height of all, in OpenCV's order of colours."""
    scale = max(width / rgb.shape[1], HEIGHT / rgb.shape[0])
    size = (max(width, round(scale * rgb.shape[1])), max(HEIGHT, round(scale * rgb.shape[0])))
    trajectory = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    large = cv2.resize(rgb, size, interpolation=trajectory)
    left, top = (size[0] - width) // 2, (size[1] - HEIGHT) // 2
    return np.ascontiguousarray(large[top : top + HEIGHT, left : left + width, ::-1])


def model(work: Path) -> None:
    """Points and cameras of eleven photographs."""
    found = epipole.reconstruct(DATA / "sfm/fountain-P11/images", work / "sfm", **FOUNTAIN).model
    cams_from_world, points = found.cams_from_world(), found.points
    centers = cams_from_world.centers()
    middle = np.median(points.xyz_in_world, axis=0)
    up, back = -cams_from_world.rotation[:, 1].mean(axis=0), centers.mean(axis=0) - middle
    reach = float(np.linalg.norm(back))
    near = np.linalg.norm(points.xyz_in_world - middle, axis=1) < 1.1 * reach
    side = np.cross(up, back) / np.linalg.norm(up)
    shown = np.vstack([middle + 0.4 * (points.xyz_in_world[near] - middle), centers])
    view = View.around(shown, back + 0.8 * side + 0.7 * reach * up, up, 700)
    view.points(points.xyz_in_world[near], points.rgb[near], 4)
    for image in range(len(found.images)):
        camera = found.cameras[int(found.camera_of_image[image])]
        view.frustum(camera, cams_from_world[image], 0.12 * reach)
    save("model", view.small())


def stereo(_: Path) -> None:
    """An image of a pair, and its depth: near blue, far red, black where it is not known."""
    left, right = (read_rgb(DATA / f"stereo/motorcycle/motorcycle_{side}.png") for side in ("left", "right"))
    rig = RectifiedRig(
        focal_px=994.978, cx=311.193, cy=254.877, baseline=0.193001, principal_offset_px=31.086
    )
    depth = depth_of(match_stereo(left, right), rig).depth
    save("stereo", np.hstack([filled(left, WIDTH // 2), filled(color_map(depth), WIDTH // 2)]))


def slam(work: Path) -> None:
    """The path of a hand-held depth camera over the points of its map, from above and behind."""
    epipole.slam(DATA / "slam/7scenes", work / "slam")
    path = read_trajectory(work / "slam/trajectory.txt").world_from_body
    points = read_colmap_model(work / "slam/sparse/0").points
    middle, positions = np.median(points.xyz_in_world, axis=0), path.translation
    up, back = -path.rotation[:, :, 1].mean(axis=0), positions.mean(axis=0) - middle
    distances = np.linalg.norm(points.xyz_in_world - middle, axis=1)
    near = distances < np.percentile(distances, 75)
    view = View.around(
        np.vstack([points.xyz_in_world[near], positions]), back + 1.2 * np.linalg.norm(back) * up, up, 900
    )
    view.points(points.xyz_in_world, points.rgb, 4)
    colors = color_map(np.arange(len(positions), dtype=float))
    for n in range(len(positions) - 1):
        view.path(positions[n : n + 2], tuple(int(c) for c in colors[n][::-1]), 6)
    save("slam", view.small())


def splat(work: Path) -> None:
    """A view that was held out of the training: drawn from Gaussians, and the photograph."""
    epipole.splat(work / "sfm", work / "splat", time="60s", max_side_px=512, test=HELD_OUT)
    rendered = read_rgb(next((work / "splat/test").glob(f"{Path(HELD_OUT).stem}*.png")))
    truth = read_rgb(DATA / "sfm/fountain-P11/images" / HELD_OUT)
    save("splat", np.hstack([filled(rendered, WIDTH // 2), filled(truth, WIDTH // 2)]))


if __name__ == "__main__":
    requested = sys.argv[1:] or ["model", "stereo", "slam", "splat"]
    with tempfile.TemporaryDirectory(prefix="front") as folder:
        for render in (model, stereo, slam, splat):
            if render.__name__ in requested or (render is model and "splat" in requested):
                render(Path(folder))
