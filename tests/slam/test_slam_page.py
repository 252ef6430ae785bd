"""The report of a run, its view in the browser, and the view while it goes on."""

import re
import shutil
import threading
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from slam_rides import MONO, STEREO, ride, tracked, write_pairs

from epipole import api
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.pipelines.slam import run as slam_run
from epipole.pipelines.slam.frames import TrackingState
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.output import page as slam_page
from epipole.pipelines.slam.output import results as slam_results
from epipole.pipelines.slam.output.export import reconstruction_of
from epipole.pipelines.slam.output.live import LOCALIZED_RGB, WAITING_RGB, BrowserView, image_with_points
from epipole.pipelines.slam.output.rendering import LOOPS, loop_curve, path_curve, upright_from_world
from epipole.pipelines.slam.output.scene import is_mine
from epipole.scene import Trajectory
from epipole.viewer.live import Budget
from epipole.viewer.ports import port_for

OPEN = urllib.request.build_opener(urllib.request.ProxyHandler({})).open
LOOP = {
    "frame": 11,
    "keyframe": 0,
    "verdict": "accepted",
    "reason": "",
    "num_matches": 80,
    "num_agreeing": 61,
}
FALSE_LOOP = {"frame": 9, "keyframe": 1, "verdict": "rejected", "reason": "3 of 40 <matches> agree"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run over pairs with its truth, and what its page was made of."""
    folder = write_pairs(tmp_path_factory.mktemp("slam") / "ride")
    pages = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            slam_results, "render_page", lambda page: pages.append(page) or slam_page.render_page(page)
        )
        result = slam_run.slam(folder, folder.parent / "out", truth=folder)
    return folder, result, pages[0]


def table_after(html: str, title: str) -> str:
    return html.split(f"<h2>{title}</h2>", 1)[1].split("</section>", 1)[0]


def test_the_report_tells_what_came_out(made):
    _, result, page = made
    html = (result.out / "report.html").read_text(encoding="utf-8")
    assert "12 of 12 frames localized" in html and "meters, from the baseline of 0.12 m" in html
    assert "up to scale" not in html
    assert "No loop was closed" in table_after(html, "Loops")
    truth = table_after(html, "Errors")
    assert truth.count("<tr") == 5 and f"{result.summary['truth']['final']['rigid']['ate_rmse']:.3g}" in truth
    frames = table_after(html, "Frames")
    titles = re.findall(r"<h3>(.*?)</h3>", frames)
    assert titles == ["Error", "Inliers", "Position uncertainty", "Time per frame"]
    assert frames.count('class="series') == 5
    assert table_after(html, "States").count('class="band-tracking"') == 1
    assert page.final.path_length() == pytest.approx(result.trajectory.path_length())


def test_loops_are_listed_and_accepted_ones_drawn(made):
    _, _, page = made
    summary = {**page.summary, "loops": [LOOP, FALSE_LOOP]}
    html = slam_page.render_page(replace(page, summary=summary))
    loops = table_after(html, "Loops")
    assert (
        "2 loop candidates, 1 accepted" in loops
        and "3 of 40 &lt;matches&gt; agree" in loops
        and ">61<" in loops
    )
    assert f'"name":"{LOOPS}"' in html and f'"name":"{LOOPS}"' not in slam_page.render_page(page)
    names = list(page.model.images.name)
    rendered = loop_curve([LOOP, FALSE_LOOP], page.model, [int(n[:6]) for n in names])
    centers = page.model.camera_centers_in_world()
    np.testing.assert_array_equal(rendered.segments_in_world, [[centers[-1], centers[0]]])


def test_lengths_without_a_unit_are_said_to_have_none(made, tmp_path):
    folder, result, _ = made
    f, _, cx, cy = result.summary and (260.0, 260.0, 160.0, 120.0)
    given = {"camera_params": f"{f},{f},{cx},{cy}"}
    slam_run.slam(folder / "image_0", tmp_path / "out", **given, truth=folder / "poses.txt")
    html = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert (
        "The trajectory is up to scale" in html
        and "map units, up to scale" in html
        and "use the Sim(3) rows" in html
    )
    states = table_after(html, "States")
    assert 'class="band-starting"' in states and "the camera hardly moves" in states


def test_its_script_runs_to_its_end(made, tmp_path, browser):
    _, _, page = made
    summary = {**page.summary, "loops": [LOOP]}
    (tmp_path / "page.html").write_text(
        slam_page.render_page(replace(page, summary=summary)), encoding="utf-8"
    )
    tab = browser.new_page()
    tab.goto((tmp_path / "page.html").as_uri())
    assert tab.locator("html").get_attribute("data-ready") == "yes"
    tab.close()


def test_paths_are_broken_where_the_place_was_not_known():
    times = np.array([0.0, 0.1, 0.2, 0.5, 0.6])
    path = Trajectory(times, Rigid3(np.tile(np.eye(3), (5, 1, 1)), np.arange(15.0).reshape(5, 3)))
    pieces = path_curve("p", path, (1, 2, 3)).segments_in_world
    assert pieces[:, 0, 0].tolist() == [0, 3, 9] and pieces[:, 1, 0].tolist() == [3, 6, 12]
    single = path_curve("p", Trajectory(times[:1], path.world_from_body[:1]), (1, 2, 3))
    assert len(single.segments_in_world) == 0


def test_up_is_up():
    """A level camera's -y is up, its z ahead; a tilted one that turns around is turned upright."""
    level = upright_from_world(Rigid3.identity(1))
    np.testing.assert_allclose(
        level.apply(np.array([[0, -1.0, 0], [0, 0, 1.0]])), [[0, 0, 1], [0, 1, 0]], atol=1e-12
    )
    tilt = Rigid3.exp(np.array([0, 0, 0, 0.4, 0, 0])).rotation
    rotations = Rigid3.exp(
        np.array([[0, 0, 0, 0, a, 0] for a in np.linspace(0, 2 * np.pi, 12, endpoint=False)])
    )
    world = tilt.T @ rotations.rotation @ tilt
    upright = upright_from_world(Rigid3(world, np.zeros((12, 3))))
    np.testing.assert_allclose(upright.rotation @ tilt.T @ [0, -1.0, 0], [0, 0, 1], atol=1e-9)


def test_a_result_can_be_viewed(made, tmp_path):
    _, result, _ = made
    assert is_mine(result.out)
    handle = api.view(result.out, block=False)
    try:
        with OPEN(handle.url, timeout=10) as answer:
            assert answer.status == 200
    finally:
        handle.stop()
    lone = tmp_path / "lone"
    shutil.copytree(result.out, lone)
    shutil.rmtree(lone / "sparse")
    with pytest.raises(FileFormatError, match="no map"):
        api.view(lone, block=False)


def test_a_run_is_shown_while_it_goes_on(made, tmp_path, monkeypatch, capsys):
    folder, result, _ = made
    seen = []
    show = BrowserView.show

    def watched(self, system, frame, answer):
        show(self, system, frame, answer)
        if not seen:
            with OPEN(re.search(r"http://\S+", capsys.readouterr().err)[0], timeout=10) as page:
                seen.append(page.status)

    monkeypatch.setattr(BrowserView, "show", watched)
    again = slam_run.slam(folder, tmp_path / "out", view=True)
    assert seen == [200]
    np.testing.assert_array_equal(
        again.trajectory.world_from_body.translation, result.trajectory.world_from_body.translation
    )
    with pytest.raises(ConfigError, match="live view"):
        slam_run.slam(folder, tmp_path / "out", port=8123)


def test_a_tab_sees_the_run_to_its_end(made, tmp_path, browser):
    """Opened in the middle of the run, which waits for it."""
    folder, result, _ = made
    port, is_listening, is_open = port_for("127.0.0.1", None), threading.Event(), threading.Event()
    problems = []

    def wait_for_the_tab(progress):
        if progress.stage == "track" and progress.done >= 6:
            is_listening.set()
            is_open.wait(60)

    def run():
        try:
            slam_run.slam(folder, tmp_path / "out", view=True, port=port, progress=wait_for_the_tab)
        except BaseException as error:
            problems.append(error)
            raise

    running = threading.Thread(target=run)
    page = browser.new_page(viewport={"width": 900, "height": 700})
    page.on("pageerror", lambda error: problems.append(error))
    page.on("console", lambda said: problems.append(said.text) if said.type == "error" else None)
    running.start()
    try:
        assert is_listening.wait(60)
        page.goto(f"http://127.0.0.1:{port}/")
        page.wait_for_selector("html[data-live=running]")
        is_open.set()
        page.wait_for_selector("html[data-live=final]", timeout=60_000)
    finally:
        is_open.set()
        running.join(60)
    seen = page.evaluate(
        """space.then(s => ({ points: s.data.points[0].count, keyframes: s.data.cameras.names.length,
        path: s.data.curves[0].count, near: s.view.eye().focus, width: document.getElementById("live-image").naturalWidth }))"""
    )
    assert (
        seen["points"] == result.summary["num_points"]
        and seen["keyframes"] == result.summary["num_keyframes"]
    )
    assert seen["path"] == 11 and seen["width"] == 320
    at_end = result.trajectory.world_from_body.translation[-1]
    np.testing.assert_allclose(
        np.add(seen["near"], page.evaluate("space.then(s => s.data.origin)")), at_end, atol=0.02
    )
    text = page.inner_text(".lead")
    assert "The run has ended" in text and f"{result.summary['num_keyframes']} keyframes" in text
    page.close()
    assert problems == []


def test_a_snapshot_does_not_change_with_the_map():
    slam, _ = tracked(ride(count=1).frames("mono"), MONO)
    first = slam.snapshot()
    assert (
        first.state is TrackingState.ROTATING
        and len(first.tracked_px) > 50
        and not first.is_triangulated.any()
    )
    slam, _ = tracked(ride(count=3).frames("stereo"), STEREO)
    before = slam.snapshot()
    points = before.points_in_world.copy()
    slam.map.rescale(2.0)
    np.testing.assert_array_equal(before.points_in_world, points)
    assert len(before.points_in_world) == np.isfinite(slam.map.xyz[:, 0]).sum()
    assert before.is_triangulated.sum() > 50 and len(before.world_from_keyframes.rotation) == len(
        slam.map.keyframes
    )


def test_a_budget_keeps_its_share(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("epipole.viewer.live.perf_counter", lambda: now[0])
    budget = Budget(0.1, 0.05)
    spent = 0.0
    for _ in range(2000):
        now[0] += 0.01
        if budget.allows():
            now[0] += 0.02
            spent += 0.02
            budget.spend(0.02)
    assert 0.08 < spent / (now[0] - 100.0) <= 0.1 and budget.spent_s == pytest.approx(spent)


def test_followed_points_are_drawn_where_they_are():
    rendered = image_with_points(
        np.zeros((480, 960), np.uint8), np.array([[200.5, 100.5], [700.5, 300.5]]), np.array([True, False])
    )
    assert rendered.shape == (240, 480, 3)
    assert (
        tuple(rendered[50, 100]) == LOCALIZED_RGB
        and tuple(rendered[150, 350]) == WAITING_RGB
        and not rendered[200, 20].any()
    )


def test_a_run_that_localizes_one_frame_has_a_report(made):
    """Without a keyframe, a point or a path there is no scene to show."""
    one = made[2].final[np.arange(1)]
    page = replace(
        made[2], model=reconstruction_of(SlamMap(), STEREO.camera, ()), final=one, causal=one, truth=None
    )
    html = slam_page.render_page(page)
    assert "the camera was not localized, or hardly moved" in table_after(html, "Trajectory and map")
