"""A training that is watched: from where the browser looks, within its share of the time."""

import json
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from browser_tab import BROWSER, open_tab
from fields_scenes import CAMERA, WHITE, frames_of, lens, scene, views

from epipole import splat
from epipole.errors import ConfigError
from epipole.fields.rasterizer import render
from epipole.geometry import Rotation3
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.pictures import FieldPictures
from epipole.pipelines.fields.watching import BrowserWatch, Watch, open_watch
from epipole.synthetic import look_at
from epipole.viewer.field_watch import SIDE_PX, camera_of
from epipole.viewer.server import open_server


def test_the_camera_is_that_of_the_browser():
    place = look_at((2.0, 1.0, 0.5), (0, 0, 0)).inverse()
    quat = Rotation3(place.rotation).as_quat_wxyz()
    seen = SimpleNamespace(aspect=1.5, fov=np.deg2rad(60.0), wxyz=quat, position=place.translation)
    camera, cam_from_world = camera_of(seen)
    assert (camera.width, camera.height) == (480, SIDE_PX)
    np.testing.assert_allclose(
        camera.project(cam_from_world.apply(np.zeros((1, 3)))), [[239.5, 159.5]], atol=1e-9
    )
    rays = camera.unproject(np.array([[239.5, -0.5], [239.5, 319.5]]))
    angle = np.arccos(rays[0] @ rays[1] / np.prod(np.linalg.norm(rays, axis=1)))
    assert abs(np.rad2deg(angle) - 60.0) < 1e-9
    seen.aspect = 1e9
    assert camera_of(seen)[0].width == 4 * SIDE_PX


class Slow:
    """A viewer whose pictures take their time."""

    def __init__(self, someone_looks):
        self.someone_looks, self.spent, self.drawn = someone_looks, 0.0, []

    def show(self, draw, words):
        if self.someone_looks:
            begin = time.perf_counter()
            self.drawn.append(draw(CAMERA, views()[0].cam_from_world))
            time.sleep(0.02)
            self.spent += time.perf_counter() - begin
        return int(self.someone_looks)


class Known:
    """A trainer that has learnt."""

    num_steps = 7

    def draw(self, view):
        return render(scene(), view.camera, view.cam_from_world).over(WHITE)


@pytest.mark.parametrize("someone_looks", [True, False])
def test_a_tenth_of_the_time_is_given_to_it(someone_looks):
    Known().draw(views()[0])  # compiled
    viewer = Slow(someone_looks)
    watch, begin = BrowserWatch(viewer), time.perf_counter()
    while time.perf_counter() < begin + 2.0:
        watch.show(Known(), 0.5)
        time.sleep(0.001)
    # One picture more, for what the next one takes is only known from the last.
    assert viewer.spent < 0.2 + 0.05 and (len(viewer.drawn) > 2) == someone_looks
    for picture in viewer.drawn:
        np.testing.assert_array_equal(picture, Known().draw(views()[0]))


def test_nothing_is_opened_that_nobody_asked_for():
    none = FieldPictures([], [], np.empty((0, 3)), np.empty((0, 3), np.uint8), False, [])
    with open_watch(FieldOptions(), none) as watch:
        assert type(watch) is Watch


def test_a_port_in_use_is_told(tmp_path):
    server = open_server("127.0.0.1", None)
    try:
        folder = tmp_path / "scene"
        folder.mkdir()
        (folder / "transforms.json").write_text(json.dumps(lens() | {"frames": frames_of(views(), folder)}))
        with pytest.raises(ConfigError, match="in use"):
            splat(folder, tmp_path / "out", steps=3, view=True, port=server.get_port())
    finally:
        server.stop()


@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_a_browser_sees_the_scene(tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "transforms.json").write_text(json.dumps(lens() | {"frames": frames_of(views(), folder)}))
    server = open_server("127.0.0.1", None)
    port = server.get_port()
    server.stop()
    looked = threading.Event()

    def until_it_was_seen(_progress):
        if looked.is_set():
            raise KeyboardInterrupt

    options = {"time": "40s", "max_gaussians": 300, "sh_degree": 0, "view": True, "port": port}
    options["progress"] = until_it_was_seen
    training = threading.Thread(target=splat, args=(folder, tmp_path / "out"), kwargs=options)
    training.start()
    try:
        with open_tab(tmp_path) as tab:
            stop, text, picture = time.monotonic() + 30, "", np.zeros(1)
            # A page that is asked for before the server listens is asked for again.
            while time.monotonic() < stop and ("% of the training" not in text or picture.std() < 5):
                if "% of the training" not in text:
                    tab.call("Page.navigate", url=f"http://127.0.0.1:{port}")
                time.sleep(1.5)
                text = tab.value("document.body ? document.body.innerText : ''")
                picture = tab.picture({"x": 300, "y": 200, "width": 200, "height": 300})
            assert "% of the training" in text and picture.std() > 5  # coloured balls before white
    finally:
        looked.set()
        training.join()
    assert (tmp_path / "out" / "splat.ply").is_file()
