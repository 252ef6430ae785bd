"""Every kind of path in a headless browser: it is drawn, says no error and loads nothing from elsewhere; and as one file."""

import base64
import io
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from viewer_scenes import HOSTILE, OPEN, free_port, three_cameras

from epipole import api
from epipole.cameras import Camera
from epipole.errors import FileFormatError
from epipole.fields.nerf.voxel_field import voxels_on
from epipole.geometry import Rigid3
from epipole.io import write_colmap_model
from epipole.io.calibration.files import CalibrationFile, write_calibration
from epipole.io.gaussians.files import write_gaussians
from epipole.io.images.depth_maps import write_pfm, write_png16
from epipole.io.meshes.mesh_ply import write_mesh_ply
from epipole.io.meshes.ply import write_points_ply
from epipole.io.trajectories.files import write_trajectory
from epipole.pipelines.fields.kinds import KINDS as KINDS_OF_FIELDS
from epipole.pipelines.sfm.page.scene import image_loader
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.output.map_file import write_slam_map
from epipole.pipelines.stereo.config import StereoConfig
from epipole.scene import RectifiedRig, Trajectory
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.synthetic.stereo_rooms import stereo_room
from whole import IS_WHOLE

CAMERA = Camera("PINHOLE", 64, 48, [50.0, 50.0, 31.5, 23.5])
RNG = np.random.default_rng(3)
SECONDS = 60.0


def ball(n: int) -> np.ndarray:
    positions = RNG.normal(size=(n, 3))
    return positions / np.linalg.norm(positions, axis=1, keepdims=True)


def colors(n: int) -> np.ndarray:
    return RNG.integers(60, 255, (n, 3), dtype=np.uint8)


def image(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(RNG.integers(0, 255, (48, 64, 3), dtype=np.uint8)).save(path)


def workspace(folder: Path) -> Path:
    write_colmap_model(three_cameras(40), folder / "sparse" / "0")
    image(folder / "images" / "a.jpg")
    image(folder / "images" / HOSTILE)
    return folder


def model(folder: Path) -> Path:
    write_colmap_model(three_cameras(40), folder)
    return folder


def points(folder: Path) -> Path:
    write_points_ply(folder / "points.ply", ball(500), colors(500))
    head, _, rest = (folder / "points.ply").read_bytes().partition(b"\nelement")
    script = b"\ncomment <script>alert(1)</script>"
    (folder / "points.ply").write_bytes(head + script + b"\nelement" + rest)
    return folder / "points.ply"


def mesh(folder: Path) -> Path:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    write_mesh_ply(folder / "mesh.ply", corners, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]], colors(4))
    return folder / "mesh.ply"


def gaussians(folder: Path) -> Path:
    arrays = (ball(200), np.full((200, 3), -2.5), RNG.normal(size=(200, 4)), np.full(200, 2.0))
    sh = RNG.uniform(0.5, 1.5, (200, 1, 3))
    write_gaussians(folder / "a.ply", GaussianCloud(*(np.asarray(a, np.float32) for a in (*arrays, sh))))
    return folder / "a.ply"


def grid(folder: Path) -> Path:
    voxels = voxels_on(np.ones((6, 6, 6), bool), np.full(3, -1.0), 2.0 / 6, 2.0 / 6)
    voxels.values[:, 0] = -20.0
    voxels.values[voxels.row_of[2:5, 2:5, 2:5].ravel(), 0] = 200.0
    voxels.values[:, 1:4] = RNG.uniform(0.0, 1.5, (len(voxels.values), 3))
    KINDS_OF_FIELDS["grid"].write(folder / KINDS_OF_FIELDS["grid"].file, voxels)
    return folder


def depth_map(folder: Path) -> Path:
    depths = np.fromfunction(lambda y, x: 2 + 0.01 * x + 0.02 * y, (48, 64))
    depths[10, 10] = np.nan
    write_pfm(folder / "depths.pfm", depths)
    return folder / "depths.pfm"


def depth_png(folder: Path) -> Path:
    write_png16(folder / "depths.png", np.fromfunction(lambda y, x: 2 + 0.01 * x, (48, 64)))
    return folder / "depths.png"


def pair(folder: Path) -> Path:
    seen = stereo_room(8, (160, 120))
    for side in ("left", "right"):
        Image.fromarray(getattr(seen, side)).save(folder / f"{side}.png")
    rig = RectifiedRig(seen.camera.K[0, 0], 79.5, 59.5, seen.baseline)
    files = (folder / "left.png", folder / "right.png")
    api.stereo(*files, folder / "deep", StereoConfig(max_disparity_px=40), rig)
    return folder / "deep"


def path() -> Trajectory:
    rotations = np.linspace(0, 5, 30)
    motions = np.stack([*np.zeros((3, 30)), np.zeros(30), rotations, np.zeros(30)], axis=1)
    positions = np.stack([np.cos(rotations), np.zeros(30), np.sin(rotations)], axis=1)
    return Trajectory(rotations, Rigid3(Rigid3.exp(motions).rotation, positions))


def trajectory(folder: Path) -> Path:
    write_trajectory(path(), folder / "path.txt")
    return folder / "path.txt"


def tracked(folder: Path) -> Path:
    write_trajectory(path(), folder / "trajectory.txt")
    write_trajectory(path(), folder / "trajectory_causal.txt")
    write_colmap_model(three_cameras(40), folder / "sparse" / "0")
    (folder / "summary.json").write_text('{"is_metric": true, "loops": []}')
    return folder


def map_file(folder: Path) -> Path:
    known, n = SlamMap(), 30
    rows = known.add_points(ball(n) + np.array([0.0, 0.0, 4.0]), np.full((n, 2), 5.0), np.zeros(n, np.int64))
    for k in range(2):
        seen = Observations(np.full((n, 2), 5.0), np.full(n, np.nan), rows)
        gray = RNG.integers(0, 255, (48, 64), dtype=np.uint8)
        position = Rigid3(np.eye(3), np.array([0.3 * k, 0, 0]))
        known.keyframes.append(Keyframe(k, float(k), gray, position, seen))
    write_slam_map(folder / "map.npz", known, ["a.png", "b.png"], SlamCamera(CAMERA))
    return folder / "map.npz"


def calibration(folder: Path) -> Path:
    camera = Camera("SIMPLE_RADIAL", 64, 48, [50.0, 31.5, 23.5, -0.1])
    positions = Rigid3(np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 0], [-0.2, 0, 0]]))
    write_calibration(folder / "calibration.json", CalibrationFile((camera, camera), positions), {})
    return folder / "calibration.json"


KINDS = (
    *(workspace, model, points, mesh, gaussians, grid, depth_map, depth_png, pair, trajectory, tracked),
    *(map_file, calibration),
)


OPENED_ALONE = (mesh, grid, depth_map, tracked)
"""Kinds whose files are opened in every run: each has other layers; points, cameras and Gaussians are opened by other tests."""


class Opened:
    """A page in a tab, its errors and what it asked for."""

    def __init__(self, browser: Any, address: str | None, width: int = 900, height: int = 700) -> None:
        self.page = browser.new_page(viewport={"width": width, "height": height}, reduced_motion="reduce")
        self.problems: list[str] = []
        self.requested: list[str] = []
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on(
            "console", lambda given: self.problems.append(given.text) if given.type == "error" else None
        )
        self.page.on("request", lambda request: self.requested.append(request.url))
        self.page.on("dialog", lambda dialog: (self.problems.append("dialog"), dialog.dismiss()))
        if address is not None:
            self.open(address)

    def open(self, address: str) -> None:
        """Load another page in the same tab; what was requested is counted anew."""
        self.requested.clear()
        self.page.goto(address)
        self.improve()

    def improve(self) -> None:
        end = time.monotonic() + SECONDS
        while self.page.evaluate("document.getElementById('space').dataset.settled") != "yes":
            assert time.monotonic() < end, (self.problems, self.page.inner_text("#no-drawing"))
            time.sleep(0.02)

    def rendered(self) -> np.ndarray:
        """(h, w, 3) the canvas alone."""
        self.improve()
        address = self.page.evaluate(
            """() => space.then(s => new Promise(done => s.snapshot(blob => { const reader = new FileReader();
            reader.onload = () => done(reader.result); reader.readAsDataURL(blob); })))"""
        )
        png = base64.b64decode(address.partition(",")[2])
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(float)

    def close(self) -> None:
        self.page.close()
        assert self.problems == []


def is_blank(rendered: np.ndarray) -> bool:
    return (
        float(np.abs(rendered - rendered[0, 0]).max()) < 30
        or np.mean((rendered != rendered[0, 0]).any(axis=2)) < 0.001
    )


@pytest.fixture(scope="module")
def tab(browser: Any) -> Iterator[Opened]:
    """One small tab for all kinds."""
    opened = Opened(browser, None, 240, 200)
    yield opened
    opened.close()


@pytest.mark.parametrize("make", KINDS, ids=lambda make: make.__name__)
def test_every_kind_is_shown_and_shared(make: Any, tab: Opened, tmp_path: Path) -> None:
    shown = make(tmp_path)
    handle = api.view(shown, port=free_port(), block=False)
    try:
        tab.open(handle.url)
        served = tab.rendered()
        assert not is_blank(served)
        assert all(url.startswith((handle.url, "blob:", "data:")) for url in tab.requested)
    finally:
        handle.stop()
    page = api.share(shown, tmp_path / "page.html")
    given = json.loads(
        page.read_text(encoding="utf-8").partition('id="space-data">')[2].partition("</script>")[0]
    )
    assert given["origin"] and tab.problems == []
    if not IS_WHOLE and make not in OPENED_ALONE:
        return
    tab.open(page.as_uri())
    alone = tab.rendered()
    assert all(url.startswith((page.as_uri(), "blob:", "data:")) for url in tab.requested)
    assert tab.problems == []
    # The same but for the height of the page's words.
    assert not is_blank(alone) and abs(alone.mean() - served.mean()) < 6


def test_what_is_nothing_to_see_is_told(tmp_path: Path) -> None:
    for name, content in {
        "empty.ply": b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        "text.txt": b"no path\n",
        "photo.png": b"\x89PNG\r\n\x1a\n",
        "map.npz": b"PK",
        "calibration.json": b"{}",
        "unknown.bin": b"",
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError):
            api.view(tmp_path / name, port=free_port(), block=False)
    for wrong in (tmp_path, tmp_path / "none"):
        with pytest.raises(FileFormatError):
            api.view(wrong, port=free_port(), block=False)


def test_a_file_of_another_kind_is_told_as_such(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text("1")
    with pytest.raises(FileFormatError, match="not a file that can be shown"):
        api.view(tmp_path / "script.py", port=free_port(), block=False)


def test_a_pair_without_depth_is_told(tmp_path: Path) -> None:
    for side in ("left", "right"):
        image(tmp_path / f"{side}.png")
    files = (tmp_path / "left.png", tmp_path / "right.png")
    api.stereo(*files, tmp_path / "flat", StereoConfig(max_disparity_px=16))
    with pytest.raises(FileFormatError, match="no depth"):
        api.view(tmp_path / "flat", port=free_port(), block=False)


def test_pictures_are_read_when_they_are_looked_at_and_stay_in_their_folder(tmp_path: Path) -> None:
    workspace(tmp_path)
    handle = api.view(tmp_path, port=free_port(), block=False)
    try:
        with OPEN(f"{handle.url}/picture/0", timeout=10) as answer:
            assert Image.open(io.BytesIO(answer.read())).size == (64, 48)
        (tmp_path / "images" / "a.jpg").unlink()
        with pytest.raises(OSError, match="404"):
            OPEN(f"{handle.url}/picture/0", timeout=10)
    finally:
        handle.stop()
    handle.stop()
    with pytest.raises(OSError):
        OPEN(handle.url, timeout=2)


@pytest.mark.parametrize("name", ["../secret.png", "a/../../secret.png", "/secret.png", "link/secret.png"])
def test_a_name_that_leaves_the_folder_of_pictures_is_not_read(name: str, tmp_path: Path) -> None:
    image(tmp_path / "secret.png")
    image(tmp_path / "images" / "a.png")
    (tmp_path / "images" / "link").symlink_to(tmp_path)
    assert image_loader(tmp_path / "images")("a.png") is not None
    assert image_loader(tmp_path / "images")(name) is None


def test_hostile_names_are_text(browser: Any, tmp_path: Path) -> None:
    page = api.share(workspace(tmp_path / HOSTILE), tmp_path / "page.html")
    text = page.read_text(encoding="utf-8")
    assert "<img src" not in text and "alert(1)</script>" not in text
    given = json.loads(text.partition('id="space-data">')[2].partition("</script>")[0])
    assert given["cameras"]["names"] == ["a.jpg", HOSTILE] and given["title"] == HOSTILE
    tab = Opened(browser, page.as_uri())
    tab.page.click("#next-camera")
    tab.page.click("#next-camera")
    assert tab.page.inner_text("#camera-name") == f"2 of 2: {HOSTILE}"
    assert tab.page.locator("#camera-picture").get_attribute("alt").endswith(HOSTILE)
    assert tab.page.inner_text("h1") == HOSTILE
    tab.close()
