"""A training that is watched: what the page shows, within its fraction of the time."""

import threading
import time

import numpy as np
import pytest
from browser_tab import Tab
from fields_scenes import CAMERA, WHITE, scene, views

from epipole import nerf, splat
from epipole.errors import ConfigError
from epipole.fields.splat.rasterizer import render
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.images import FieldImages
from epipole.pipelines.fields.scene import cameras_of
from epipole.pipelines.fields.watching import FRACTION, BrowserWatch, Watch, open_watch
from epipole.report.space_scene import SpaceScene
from epipole.viewer.live import LiveScene
from epipole.viewer.page_server import PageServer, fixed
from epipole.viewer.ports import port_for
from epipole.viewer.requested_views import RequestedViews
from whole import in_whole_run

FINAL = "document.documentElement.dataset.live === 'final'"
BLOBS = {"sh_degree": 0, "max_gaussians": 300, "steps": 30}
LONGEST_S = 60.0


class Page(LiveScene):
    """An open page with a tab or without one."""

    is_watched = False

    def __init__(self, is_watched):
        self.is_watched, self.states = is_watched, []

    def publish(self, state, make_scene=None, **parts):
        self.states.append(state)


class Slow(RequestedViews):
    """Views that take their time."""

    spent = longest = 0.0

    def __init__(self):
        self.rendered = []

    def render_next(self, render):
        start = time.perf_counter()
        self.rendered.append(render(CAMERA, views()[0].cam_from_world))
        time.sleep(0.02)
        took = time.perf_counter() - start
        self.spent, self.longest = self.spent + took, max(self.longest, took)
        return True


class Known:
    """A trainer that has learned."""

    num_steps, background, field, table = 7, WHITE, None, {}
    step = render_counted = state = restore = __len__ = lambda self, *_: 0

    def render(self, view):
        return render(scene(), view.camera, view.cam_from_world).over(WHITE)


@pytest.mark.parametrize("is_watched", [True, False])
def test_a_fraction_of_the_time_is_given_to_it(is_watched):
    Known().render(views()[0])  # compiled
    page, slow = Page(is_watched), Slow()
    cameras = SpaceScene("", "", "", cameras=cameras_of(views()))
    watch, start = BrowserWatch(page, slow, cameras), time.perf_counter()
    elapsed = 0.0
    # On a busy machine a view takes long, and the next one waits for its fraction of the time.
    while elapsed < 1.5 or (is_watched and len(slow.rendered) < 2 and elapsed < 20):
        watch.show(Known(), 0.5)
        time.sleep(0.001)
        elapsed = time.perf_counter() - start
    # One view more, since the time of the next one is only known from the last.
    assert slow.spent < elapsed * FRACTION + slow.longest + 0.01 and (len(slow.rendered) > 1) == is_watched
    assert bool(page.states) == is_watched
    for image in slow.rendered:
        np.testing.assert_array_equal(image, Known().render(views()[0]))


def test_nothing_is_opened_that_nobody_asked_for():
    none = FieldImages([], [], np.empty((0, 3)), np.empty((0, 3), np.uint8), False, [])
    with open_watch(FieldOptions(), none, Known(), "out") as watch:
        assert type(watch) is Watch


def test_a_port_in_use_is_told(source, tmp_path):
    server = PageServer({"": fixed("text/html", b"")}, "127.0.0.1", port_for("127.0.0.1", None))
    try:
        with pytest.raises(ConfigError, match="in use"):
            splat(source, tmp_path / "out", steps=3, view=True, port=server.port)
    finally:
        server.stop()


def watched(job, source, out, options, act, tab):
    """Train with a tab open from a tenth of the training on; `act` looks at the final page."""
    port, is_listening, is_open = port_for("127.0.0.1", None), threading.Event(), threading.Event()
    results, problems = [], []

    def wait_for_the_tab(progress):
        if progress.stage == "train" and progress.done >= 10:
            is_listening.set()
            is_open.wait(LONGEST_S)

    def train():
        try:
            results.append(job(source, out, view=True, port=port, progress=wait_for_the_tab, **options))
        except BaseException as error:
            problems.append(error)
            raise
        finally:
            is_listening.set()

    training = threading.Thread(target=train)
    training.start()
    try:
        assert is_listening.wait(LONGEST_S) and not problems
        tab.open(f"http://127.0.0.1:{port}/", 480, 400)
        tab.wait_until("document.documentElement.dataset.live === 'running'")
        is_open.set()
        tab.wait_until(FINAL)
    finally:
        is_open.set()
        training.join(LONGEST_S)
    assert not problems
    act(results[0])
    assert tab.problems == []


@pytest.fixture
def tab(browser):
    opened = Tab(browser.new_page())
    yield opened
    opened.page.close()


def test_a_page_renders_the_gaussians_as_they_are_trained(source, tmp_path, tab):
    def descriptor(result):
        assert tab.value("space.then(s => s.drawn.gaussians.numbers.count)") == len(result.cloud)
        means = tab.value("space.then(s => Array.from(s.drawn.gaussians.places))")
        np.testing.assert_allclose(np.reshape(means, (-1, 3)), result.cloud.means_in_world, atol=1e-5)
        text = tab.value("document.body.innerText")
        assert "The training has ended" in text and f"{len(result.cloud):,} Gaussians" in text
        assert tab.image({"x": 180, "y": 130, "width": 120, "height": 200}).std() > 5

    watched(splat, source, tmp_path / "out", BLOBS, descriptor, tab)


@in_whole_run
def test_a_field_is_rendered_for_the_viewpoint_of_the_tab(source, tmp_path, tab):
    def descriptor(result):
        o = tab.value("space.then(s => s.view.basis().o)")
        assert tab.value("space.then(s => s.drawn.backdrop.place)") == o
        tab.wait_until("document.getElementById('space').dataset.settled === 'yes'")
        assert tab.image({"x": 180, "y": 130, "width": 120, "height": 200}).std() > 5

    watched(nerf, source, tmp_path / "out", {"kind": "grid", "steps": 40}, descriptor, tab)
