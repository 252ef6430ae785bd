"""The viewer as a server: it answers, shows what was asked for, and stops."""

import socket
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
from PIL import Image

from epipole import api
from epipole.cameras import Camera, CameraModel
from epipole.errors import FileFormatError, ShapeError
from epipole.geometry import Rigid3
from epipole.pipelines.stereo.config import StereoConfig
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, RectifiedRig, Rigs, Tracks
from epipole.scene.gaussian_cloud import GaussianCloud
from epipole.synthetic.stereo_rooms import stereo_room
from epipole.viewer import DepthView, view
from epipole.viewer.depth_viewer import DepthViewer
from epipole.viewer.model_viewer import ModelViewer
from epipole.viewer.server import open_server
from epipole.viewer.splat_view import SplatView
from epipole.viewer.splat_viewer import SplatViewer

OPEN = urllib.request.build_opener(urllib.request.ProxyHandler({})).open


def three_cameras(num_points: int = 5) -> Reconstruction:
    """Cameras at x = 0, 1, 2 that look along +y; the third is not registered. Points lie at y = 4."""
    rotation = np.broadcast_to(np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), (3, 3, 3)).copy()
    centers = np.array([[0.0, 0, 0], [1.0, 0, 0], [np.nan, 0, 0]])
    camera = Camera(CameraModel.SIMPLE_PINHOLE, 64, 48, np.array([50.0, 31.5, 23.5]))
    xyz = np.stack([np.linspace(-1, 2, num_points), np.full(num_points, 4.0), np.zeros(num_points)], axis=1)
    return Reconstruction(
        Cameras.from_list([camera]),
        Rigs.of_single_cameras(1),
        Frames(
            np.zeros(3, np.int32),
            Rigid3(rotation, -(rotation @ centers[:, :, None])[:, :, 0]),
            np.full(3, np.nan),
        ),
        Images(
            ("a.jpg", "b <i>.jpg", "c.jpg"),
            np.arange(3, dtype=np.int32),
            np.zeros(3, np.int32),
            np.array([0, num_points, 2 * num_points, 2 * num_points]),
            np.zeros((2 * num_points, 2)),
        ),
        Points(xyz, np.full((num_points, 3), 90, np.uint8), np.linspace(0.2, 1.0, num_points)),
        Tracks(
            2 * np.arange(num_points + 1),
            np.tile(np.array([0, 1], np.int32), num_points),
            np.repeat(np.arange(num_points, dtype=np.int32), 2),
        ),
    )


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_until(condition: object, seconds: float = 10.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end and not condition():
        time.sleep(0.05)
    return bool(condition())


def test_viewer_answers_loads_pictures_and_stops(capsys: pytest.CaptureFixture) -> None:
    asked = []

    def load_image(name: str) -> np.ndarray | None:
        asked.append(name)
        return np.full((480, 640, 3), 128, np.uint8) if name == "a.jpg" else None

    port = free_port()
    handle = view(three_cameras(), load_image, port=port, block=False)
    try:
        assert handle.url == f"http://127.0.0.1:{port}"
        with OPEN(handle.url, timeout=10) as answer:
            assert answer.status == 200
            assert b"<html" in answer.read().lower()
        assert wait_until(lambda: len(asked) == 2)
        assert asked == ["a.jpg", "b <i>.jpg"]
    finally:
        handle.stop()
    handle.stop()
    with pytest.raises(urllib.error.URLError):
        OPEN(handle.url, timeout=2)
    assert capsys.readouterr().out == ""


def test_an_empty_model_can_be_viewed() -> None:
    model = three_cameras(0)
    handle = view(model, lambda _: None, port=free_port(), block=False)
    try:
        with OPEN(handle.url, timeout=10) as answer:
            assert answer.status == 200
    finally:
        handle.stop()


def test_first_view_takes_in_the_scene() -> None:
    viewer = ModelViewer(open_server("127.0.0.1", free_port()), three_cameras())
    try:
        np.testing.assert_allclose(viewer.extent.focus, [0.5, 4.0, 0.0])
        # Both cameras are sqrt(0.25 + 16) away, every point nearer; they are 1 apart.
        assert viewer.extent.radius == pytest.approx(np.sqrt(16.25))
        assert viewer.frustum_size == pytest.approx(0.08 * np.sqrt(16.25))
    finally:
        viewer.stop()


def depth_view() -> DepthView:
    z = np.linspace(2.0, 4.0, 40)
    points = np.stack([z - 3.0, 0.1 * z, z], axis=1)
    picture = np.full((30, 40, 3), 120, np.uint8)
    return DepthView(
        points, np.full((40, 3), 90, np.uint8), np.linspace(0.001, 0.4, 40), picture, picture, 50.0
    )


def test_depth_of_a_pair_is_served_and_points_can_be_chosen():
    server = open_server("127.0.0.1", free_port())
    viewer = DepthViewer(server, depth_view())
    try:
        everything = len(viewer.cloud.points)
        viewer.most_error.value = 10.0
        assert wait_until(lambda: len(viewer.cloud.points) < everything)
        assert "of 40 points" in viewer.counts.content
        before = viewer.cloud.colors.copy()
        viewer.color.value = "depth"
        assert wait_until(lambda: (viewer.cloud.colors != before).any())
        size = viewer.cloud.point_size
        viewer.size.value = 2.0
        assert wait_until(lambda: viewer.cloud.point_size == pytest.approx(2 * size))
    finally:
        viewer.stop()
        viewer.stop()


def test_the_view_command_shows_depth_or_says_that_there_is_none(tmp_path):
    pair = stereo_room(8, (160, 120))
    for side in ("left", "right"):
        Image.fromarray(getattr(pair, side)).save(tmp_path / f"{side}.png")
    files = (tmp_path / "left.png", tmp_path / "right.png")
    api.stereo(*files, tmp_path / "flat", StereoConfig(max_disparity_px=40))
    with pytest.raises(FileFormatError, match="no depth"):
        api.view(tmp_path / "flat", port=free_port(), block=False)
    rig = RectifiedRig(pair.camera.K[0, 0], 79.5, 59.5, pair.baseline)
    found = api.stereo(*files, tmp_path / "deep", StereoConfig(max_disparity_px=40), rig)
    assert (tmp_path / "deep" / "rig.json").is_file() and found.num_points > 1000
    handle = api.view(tmp_path / "deep", port=free_port(), block=False)
    try:
        assert OPEN(handle.url).status == 200
    finally:
        handle.stop()
    (tmp_path / "deep" / "rig.json").write_text("{}")
    with pytest.raises(FileFormatError, match=r"rig\.json"):
        api.view(tmp_path / "deep", port=free_port(), block=False)


def test_nothing_to_show():
    with pytest.raises(ShapeError, match="no point"):
        DepthView(
            np.zeros((0, 3)),
            np.zeros((0, 3), np.uint8),
            np.zeros(0),
            *[np.zeros((2, 2, 3), np.uint8)] * 2,
            1.0,
        )


def test_gaussians_are_served_and_faint_ones_can_be_taken_away(rng):
    shapes = ((30, 3), (30, 3), (30, 4), (30,), (30, 4, 3))
    cloud = GaussianCloud(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))
    view = SplatView(cloud, np.array([0.0, -5.0, 1.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]), "metres")
    server = open_server("127.0.0.1", free_port())
    viewer = SplatViewer(server, view)
    try:
        assert viewer.counts.content == "30 of 30 Gaussians"
        viewer.least.value = 0.5
        viewer._choose()
        assert viewer.counts.content == f"{int((cloud.opacity_logits >= 0).sum())} of 30 Gaussians"
        with OPEN(f"http://127.0.0.1:{server.get_port()}", timeout=10) as answer:
            assert answer.status == 200
    finally:
        viewer.stop()
        viewer.stop()
    with pytest.raises(ShapeError, match="no Gaussian"):
        SplatView(cloud.rows(np.zeros(0, np.int64)), np.zeros(3), np.zeros(3), np.ones(3), "")
