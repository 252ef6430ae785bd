"""Generate the images of the tour: `python docs/make_tour_pictures.py FOLDER` (five minutes on two cores, with Chromium).

FOLDER is where the commands of docs/tour were run. Steps whose results are missing in it are run first.
"""

from __future__ import annotations

import itertools
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

from epipole.geometry import align_points
from epipole.image import color_map
from epipole.io import read_colmap_model, read_trajectory
from epipole.io.images.depth_maps import read_pfm
from epipole.io.images.photographs import read_rgb
from epipole.io.meshes.ply import write_points_ply
from epipole.robust import point_covariances
from epipole.scene import Reconstruction

IMAGES = Path(__file__).with_name("pictures")
CHROMIUM = "/usr/bin/chromium"
SOFTWARE_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WIDTH, HEIGHT = 900, 420
GAP = 6
"""Pixels between parts of an image."""
SFM_RGB, SLAM_RGB = (20, 70, 160), (225, 90, 20)
MOST_KB = 80
STEPS = {
    "demo/model/sparse/0/points3D.bin": "demo",
    "tour/model/sparse/0/points3D.bin": "reconstruct demo/photographs tour/model",
    "tour/depth/depth.pfm": "stereo --workspace tour/model --pair courtyard_003.jpg courtyard_004.jpg tour/depth",
    "tour/track/trajectory.txt": "slam demo/photographs tour/track --camera-model SIMPLE_RADIAL"
    " --camera-params 746.65,480,320,-0.0501",
    "tour/splats/splat.ply": "splat tour/model tour/splats --time 1m",
    "tour/mesh.ply": "mesh tour/splats tour/mesh.ply",
    "tour/model.html": "view tour/model --share tour/model.html",
    "tour/video.mp4": "render tour/splats tour/video.mp4",
}
"""A result and the command that writes it."""


def save(name: str, rgb: np.ndarray) -> None:
    """Write an image to docs/pictures/tour_NAME.jpg, with the highest quality and width below the size limit."""
    for width, quality in itertools.product((rgb.shape[1], 800, 700), range(90, 54, -5)):
        bgr = np.ascontiguousarray(resized(rgb, width)[..., ::-1])
        _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if len(data) < 1000 * MOST_KB:
            (IMAGES / f"tour_{name}.jpg").write_bytes(data.tobytes())
            return
    raise SystemExit(f"tour_{name}.jpg is larger than {MOST_KB} kB")


def resized(rgb: np.ndarray, width: int, height: int | None = None) -> np.ndarray:
    """Downscale to this width, and crop the rows in the middle to this height."""
    rows = round(rgb.shape[0] * width / rgb.shape[1])
    small = cv2.resize(rgb, (width, rows), interpolation=cv2.INTER_AREA)
    top = 0 if height is None else (rows - height) // 2
    return small[top : rows if height is None else top + height]


def side_by_side(*parts: np.ndarray) -> np.ndarray:
    """Images of one height next to each other, with a white gap."""
    gap = np.full((parts[0].shape[0], GAP, 3), 255, np.uint8)
    return np.hstack([piece for part in parts for piece in (gap, part)][1:])


@contextmanager
def browser() -> Iterator[Any]:
    """Headless Chromium that renders WebGL in software."""
    with sync_playwright() as started:
        opened = started.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_GL)
        yield opened
        opened.close()


def screenshot(
    page: Path, view: np.ndarray | None, size: tuple[int, int], *, scale: float = 1, is_page: bool = False
) -> np.ndarray:
    """The 3D view of a shared page, or all of the page, in pixels of the screen."""
    with browser() as opened:
        tab = opened.new_page(
            viewport={"width": size[0], "height": size[1]}, reduced_motion="reduce", device_scale_factor=scale
        )
        numbers = "" if view is None else "#view=" + ",".join(f"{value:.6f}" for value in view)
        tab.goto(page.resolve().as_uri() + numbers)
        tab.wait_for_timeout(6000)
        shown = tab.screenshot() if is_page else tab.locator("canvas").first.screenshot()
    return cv2.imdecode(np.frombuffer(shown, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def view_from_cameras(model: Reconstruction, back: float, above: float, fov_deg: float) -> np.ndarray:
    """Ten numbers for the address of a page: a view from behind the cameras and above them."""
    motions, middle = model.cams_from_world(), np.median(model.points.xyz_in_world, axis=0)
    up, away = -motions.rotation[:, 1].mean(axis=0), motions.centers().mean(axis=0) - middle
    position = middle + back * away + above * np.linalg.norm(away) * up
    return np.concatenate([position, middle, up, [fov_deg]])


def shared(folder: Path, path: Path, name: str) -> Path:
    """Write a result as one page."""
    page = folder / f"{name}.html"
    run(folder, f"view {shlex.quote(str(path.resolve()))} --share {page.name} --overwrite")
    return page


def run(folder: Path, words: str) -> None:
    """Run `epipole` in a folder."""
    subprocess.run([sys.executable, "-m", "epipole", *shlex.split(words)], cwd=folder, check=True)


def photographs(folder: Path, _: Path) -> None:
    """Two photographs, and points of the model that both of them show."""
    model = read_colmap_model(folder / "demo/model/sparse/0")
    names = ("courtyard_004.jpg", "courtyard_010.jpg")
    rows = [model.images.name.index(name) for name in names]
    image, point = model.tracks.image, model.tracks.point_of_observation()
    pixels = [dict(zip(point[image == row], model.observed_pixels()[image == row])) for row in rows]
    common = np.random.default_rng(1).permutation(sorted(pixels[0].keys() & pixels[1].keys()))[:45]
    both = side_by_side(*(read_rgb(folder / "demo/photographs" / name) for name in names))
    step = both.shape[1] - read_rgb(folder / "demo/photographs" / names[1]).shape[1]
    colors = color_map(np.array([pixels[0][key][0] for key in common]))
    canvas = np.ascontiguousarray(both)
    for key, color in zip(common, colors.tolist()):
        ends = [tuple(np.round(p[key] + [n * step, 0]).astype(int).tolist()) for n, p in enumerate(pixels)]
        cv2.line(canvas, *ends, color, 2, cv2.LINE_AA)
        for end in ends:
            cv2.circle(canvas, end, 6, color, -1, cv2.LINE_AA)
    save("photographs", resized(canvas, WIDTH))


def cameras(folder: Path, work: Path) -> None:
    """The model in the viewer, with its cameras."""
    model = read_colmap_model(folder / "tour/model/sparse/0")
    page = shared(work, folder / "tour/model", "model")
    save("cameras", screenshot(page, view_from_cameras(model, 2.5, 1.0, 36), (WIDTH + 32, HEIGHT + 180)))


def points(folder: Path, work: Path) -> None:
    """The points, colored by the logarithm of their standard deviation."""
    model = read_colmap_model(folder / "tour/model/sparse/0")
    seen = np.zeros((len(model.images), len(model.points)), bool)
    seen[model.tracks.image, model.tracks.point_of_observation()] = True
    covariances = point_covariances(
        model.cams_from_world(), model.cameras[0], model.points.xyz_in_world, seen, noise_px=0.3
    )
    sigma = np.sqrt(np.linalg.eigvalsh(covariances)[:, 2])
    limits = (float(np.log(np.quantile(sigma, 0.02))), float(np.log(np.quantile(sigma, 0.98))))
    write_points_ply(work / "points.ply", model.points.xyz_in_world, color_map(np.log(sigma), limits))
    page = shared(work, work / "points.ply", "points")
    view = view_from_cameras(model, 1.6, 0.5, 36)
    save("points", resized(screenshot(page, view, (WIDTH + 32, HEIGHT + 180), scale=2), WIDTH))


def depth(folder: Path, _: Path) -> None:
    """The rectified left image, and its depth: near is blue, far is red, unknown is black."""
    left, depths = read_rgb(folder / "tour/depth/left.png"), read_pfm(folder / "tour/depth/depth.pfm")
    save("depth", side_by_side(*(resized(part, (WIDTH - GAP) // 2) for part in (left, color_map(depths)))))


def trajectory(folder: Path, _: Path) -> None:
    """Plan of the model: the camera positions of SfM, and the trajectory of SLAM after the best similarity transform."""
    model = read_colmap_model(folder / "tour/model/sparse/0")
    order = np.argsort(model.images.name)
    known = model.cams_from_world().centers()[order]
    tracked = read_trajectory(folder / "tour/track/trajectory.txt").world_from_body.translation
    line = align_points(tracked, known).apply(tracked)
    xyz = model.points.xyz_in_world
    near = (np.abs(xyz - np.median(xyz, axis=0)) < 1.8).all(axis=1)
    scale = 3 * HEIGHT / 3.9
    shown = np.concatenate([known, xyz[near]])[:, :2]
    low = (shown.min(axis=0) + shown.max(axis=0)) / 2 - 1.5 * np.array([WIDTH, HEIGHT]) / scale
    plan = np.full((3 * HEIGHT, 3 * WIDTH, 3), 255, np.uint8)

    def pixels(positions: np.ndarray) -> np.ndarray:
        at = scale * (positions[:, :2] - low)
        return np.round([at[:, 0], 3 * HEIGHT - at[:, 1]]).astype(int).T

    for at, color in zip(
        pixels(xyz[near]).tolist(), (0.5 * model.points.rgb[near] + 110).astype(int).tolist()
    ):
        cv2.circle(plan, at, 4, color, -1, cv2.LINE_AA)
    cv2.polylines(plan, [pixels(line).reshape(-1, 1, 2)], False, SLAM_RGB, 8, cv2.LINE_AA)
    for at in pixels(known).tolist():
        cv2.circle(plan, at, 20, SFM_RGB, 6, cv2.LINE_AA)
    for row, (words, color) in enumerate((("SfM: cameras", SFM_RGB), ("SLAM: trajectory", SLAM_RGB))):
        cv2.putText(plan, words, (60, 100 + 90 * row), cv2.FONT_HERSHEY_SIMPLEX, 1.9, color, 5, cv2.LINE_AA)
    save("trajectory", resized(plan, WIDTH))


def splat(folder: Path, _: Path) -> None:
    """Rendering of a held-out view, and its photograph."""
    rendered = read_rgb(folder / "tour/splats/test/courtyard_009.png")
    photograph = read_rgb(folder / "demo/photographs/courtyard_009.jpg")
    save("splat", side_by_side(*(resized(part, (WIDTH - GAP) // 2, 290) for part in (rendered, photograph))))


def mesh(folder: Path, work: Path) -> None:
    """The mesh in the viewer."""
    model = read_colmap_model(folder / "tour/model/sparse/0")
    page = shared(work, folder / "tour/mesh.ply", "mesh")
    save("mesh", screenshot(page, view_from_cameras(model, 1.25, 0.3, 40), (WIDTH + 32, HEIGHT + 180)))


def share(folder: Path, _: Path) -> None:
    """The shared page on a phone, and four images of the video."""
    phone = screenshot(folder / "tour/model.html", None, (390, 600), scale=2, is_page=True)
    video, frames = cv2.VideoCapture(str(folder / "tour/video.mp4")), []
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    for n in (0, count // 3, 2 * count // 3, count - 1):
        video.set(cv2.CAP_PROP_POS_FRAMES, n)
        frames.append(video.read()[1][..., ::-1])
    phone = resized(phone, 270)
    width, height = (WIDTH - 270 - 2 * GAP) // 2, (phone.shape[0] - GAP) // 2
    small = [resized(frame, width) for frame in frames]
    small = [cv2.copyMakeBorder(f, 0, max(0, height - len(f)), 0, 0, 0, value=(255,) * 3) for f in small]
    gap = np.full((phone.shape[0] - 2 * height, 2 * width + GAP, 3), 255, np.uint8)
    pairs = [side_by_side(*(frame[:height] for frame in small[k : k + 2])) for k in (0, 2)]
    save("share", side_by_side(phone, np.vstack([pairs[0], gap, pairs[1]])))


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit("python docs/make_tour_pictures.py FOLDER [NAME ...]")
    tour, requested = Path(sys.argv[1]), sys.argv[2:]
    for result, command in STEPS.items():
        if not (tour / result).exists():
            run(tour, command)
    with tempfile.TemporaryDirectory(prefix="tour") as aside:
        for make_image in (photographs, cameras, points, depth, trajectory, splat, mesh, share):
            if not requested or make_image.__name__ in requested:
                make_image(tour, Path(aside))
