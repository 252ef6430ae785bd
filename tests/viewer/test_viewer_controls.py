"""Hands on the viewer's controls: layers, limits, section, distances with their errors, cameras, images."""

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from PIL import Image
from test_viewer_kinds import Opened, workspace
from viewer_scenes import free_port, three_cameras

from epipole import api
from epipole.report.space_model import points_of_model, scene_of_model
from epipole.report.space_scene import PointLayer, SpaceScene
from epipole.scene.point_accuracy import covariances_of_points
from epipole.viewer import view_scene
from epipole.viewer.scene_page import scene_page

RGB = np.full((2, 3), 255, np.uint8)


SIZE = {"width": 600, "height": 500}


@pytest.fixture(scope="module")
def tab_of_file(browser: Any) -> Iterator[Opened]:
    """One tab for all tests: each loads its page anew."""
    opened = Opened(browser, None, **SIZE)
    yield opened
    opened.close()


@pytest.fixture
def empty_tab(tab_of_file: Opened) -> Iterator[Opened]:
    """A tab of its usual size, which must say no error."""
    tab_of_file.page.set_viewport_size(SIZE)
    yield tab_of_file
    assert tab_of_file.problems == []


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Of a workspace of two cameras and forty points in a row."""
    handle = api.view(workspace(tmp_path_factory.mktemp("workspace")), port=free_port(), block=False)
    yield handle.url
    handle.stop()


@pytest.fixture
def tab(address: str, empty_tab: Opened) -> Opened:
    """The page of the workspace."""
    empty_tab.open(address)
    return empty_tab


def lit(rendered: np.ndarray) -> int:
    return int((np.abs(rendered - rendered[5, 5]).max(axis=2) > 20).sum())


def set_slider(tab: Opened, selector: str, value: float) -> None:
    tab.page.locator(selector).evaluate(
        "(input, value) => { input.value = value; input.dispatchEvent(new Event('input')); }", value
    )


def pixel_of(tab: Opened, position: np.ndarray) -> tuple[float, float]:
    """Of the page, where a place of the scene is seen."""
    x, y = tab.page.evaluate(
        """place => space.then(({ view }) => { const c = document.getElementById("space"),
        b = view.basis(), r = place.map((v, k) => v - b.o[k]), on = a => a[0] * r[0] + a[1] * r[1] + a[2] * r[2],
        f = view.focal() * c.clientWidth / c.width, box = c.getBoundingClientRect();
        return [box.left + c.clientWidth / 2 + f * on(b.r) / on(b.f), box.top + c.clientHeight / 2 + f * on(b.d) / on(b.f)]; })""",
        position.tolist(),
    )
    return x, y


def test_the_keyboard_resets_all_that_the_button_does(tab: Opened) -> None:
    for key in ("r", "R"):
        tab.page.click("#next-camera")
        assert tab.page.locator("#camera-name").inner_text().startswith("1 of 2")
        tab.page.locator("#space").focus()
        tab.page.keyboard.press(key)
        assert tab.page.locator("#camera-name").inner_text() == ""


def test_places_and_lengths_have_the_digits_that_they_are_worth(tab: Opened) -> None:
    say = "([value, radius]) => placeInWords(value, radius)"
    assert tab.page.evaluate(say, [5400000.12346, 2.7]) == "5400000.1235"  # a map in meters, far from zero
    assert tab.page.evaluate(say, [0.123456789, 0.002]) == "0.1234568"
    assert tab.page.evaluate(say, [-1234.56, 5000.0]) == "-1234.6"
    say = "([length, sigma]) => lengthInWords({ length, sigma }, 'm', '', '')"
    assert tab.page.evaluate(say, [0.742912, 0.00033]).startswith("0.74291 \u00b1 0.00033 m")
    assert tab.page.evaluate(say, [1234.567, 12.3]).startswith("1235 \u00b1 12 m")


def test_layers_limits_and_sections_take_away_what_they_say(tab: Opened) -> None:
    everything = lit(tab.rendered())
    tab.page.click("summary:has-text('Layers')")
    tab.page.click("[data-layer=cameras].show-layer")
    points = lit(tab.rendered())
    assert 0 < points < everything
    set_slider(tab, ".point-limit[data-measure='0']", 500)
    fewer = lit(tab.rendered())
    assert 0.3 * points < fewer < 0.7 * points
    assert (
        tab.page.locator(".point-limit + output").first.inner_text() == "0.598 px"
    )  # of 0.2 to 0.996, the 99.5th percentile
    set_slider(tab, ".point-limit[data-measure='0']", 1000)
    set_slider(tab, ".section-side[data-axis='0'][data-side='high']", 500)
    halved = lit(tab.rendered())
    assert 0.2 * points < halved < 0.8 * points
    tab.page.locator("#whole-section").evaluate("b => b.click()")
    assert lit(tab.rendered()) == points
    tab.page.select_option("#point-color", "1")
    assert np.ptp(tab.rendered().reshape(-1, 3), axis=0).max() > 150  # a color for each error
    tab.page.click("[data-layer='points-0']")
    assert lit(tab.rendered()) == 0


def test_a_camera_is_looked_through_and_its_picture_shown(tab: Opened) -> None:
    tab.page.click("#next-camera")
    tab.page.wait_for_selector("#camera-picture:not([hidden])")
    assert tab.page.inner_text("#camera-name") == "1 of 2: a.jpg"
    eye = tab.page.evaluate("space.then(s => s.view.basis())")
    origin = tab.page.evaluate("JSON.parse(document.getElementById('space-data').textContent).origin")
    np.testing.assert_allclose(np.array(eye["o"]) + origin, [0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(eye["f"], [0, 1, 0], atol=1e-6)
    before = tab.rendered()
    set_slider(tab, "#picture-opacity", 1.0)
    assert np.abs(tab.rendered() - before).mean() > 20
    tab.page.click("summary:has-text('More')")
    tab.page.click("#reset-view")
    tab.improve()
    assert tab.page.inner_text("#camera-name") == ""


def test_the_distance_of_two_points_and_its_deviation(empty_tab: Opened) -> None:
    """Clicked in the browser; by the same covariances as the library's."""
    base = three_cameras(2)
    noisy = replace(
        base, images=replace(base.images, keypoints_px=np.array([[20.0, 20], [40, 20], [8, 20], [28, 20]]))
    )
    layer = points_of_model(noisy)
    assert layer.covariances is not None
    handle = view_scene(scene_of_model(noisy, title="two", unit="m"), port=free_port(), block=False)
    tab = empty_tab
    tab.open(handle.url)
    origin = np.array(
        tab.page.evaluate("JSON.parse(document.getElementById('space-data').textContent).origin")
    )
    tab.page.click("#measure")
    for position in base.points.xyz_in_world:
        tab.page.mouse.click(*pixel_of(tab, position - origin))
    given = tab.page.locator("#measured")
    length = np.linalg.norm(np.diff(base.points.xyz_in_world, axis=0))
    along = np.diff(base.points.xyz_in_world, axis=0)[0] / length
    sigma = np.sqrt(along @ layer.covariances.sum(axis=0) @ along)
    assert float(given.get_attribute("data-length")) == pytest.approx(length, rel=1e-6)
    assert float(given.get_attribute("data-sigma")) == pytest.approx(sigma, rel=1e-5)
    assert given.inner_text().startswith("3.0 ± ") and " m, one standard deviation" in given.inner_text()
    tab.page.keyboard.press("Escape")
    handle.stop()


def test_the_deviation_holds_over_many_draws(rng: np.random.Generator) -> None:
    """First order against a thousand triangulations of noisy pixels."""
    model, noise = three_cameras(2), 0.05
    exact = [
        model.cameras[0].project(model.cams_from_world()[i].apply(model.points.xyz_in_world)) for i in (0, 1)
    ]
    model = replace(model, images=replace(model.images, keypoints_px=np.concatenate(exact)))
    covariances = covariances_of_points(model, noise)
    # Two cameras at x = 0 and 1, f = 50, depth 4: the disparity's deviation is sqrt(2) noise.
    pixels = 50.0 * model.points.xyz_in_world[:, 0] / 4.0
    left = pixels + noise * rng.normal(size=(20000, 2))
    right = pixels - 50.0 / 4.0 + noise * rng.normal(size=(20000, 2))
    depth = 50.0 / (left - right)
    across = left * depth / 50.0
    lengths = np.hypot(np.diff(across, axis=1), np.diff(depth, axis=1))[:, 0]
    along = np.array([1.0, 0.0, 0.0])
    assert lengths.std() == pytest.approx(np.sqrt(along @ covariances.sum(axis=0) @ along), rel=0.05)


@pytest.mark.parametrize(("unit", "words"), [("", "10, up to scale"), ("m", "10 m;")])
def test_a_distance_says_what_it_does_not_know(
    unit: str, words: str, empty_tab: Opened, tmp_path: Path
) -> None:
    xyz = np.array([[0.0, 0, 0], [10, 0, 0]])
    page = tmp_path / "page.html"
    scene = SpaceScene("two", "two points", unit, (PointLayer("Points", xyz, RGB),))
    page.write_text(scene_page(scene, 10).html, encoding="utf-8")
    tab = empty_tab
    tab.page.set_viewport_size({"width": 390, "height": 844})
    tab.open(page.as_uri())
    origin = np.array(
        tab.page.evaluate("JSON.parse(document.getElementById('space-data').textContent).origin")
    )
    tab.page.locator("#measure").press("Enter")
    for position in xyz:
        tab.page.mouse.click(*pixel_of(tab, position - origin))
    text = tab.page.inner_text("#measured")
    assert text.startswith(words) and "its error is unknown" in text
    assert tab.page.evaluate("document.documentElement.scrollWidth") <= 390
    check_own_scale(tab, has_unit=bool(unit))


def check_own_scale(tab: Opened, has_unit: bool) -> None:
    """A scene without a unit gets one from a length that a person knows; the browser keeps it until it is undone."""
    if has_unit:
        assert tab.page.locator("#set-scale").count() == 0
        return
    tab.page.fill("#true-length", "2.5")
    tab.page.click("#set-scale button")
    assert tab.page.inner_text("#measured").startswith("2.5 m, with the scale set here")
    tab.page.reload()
    tab.page.wait_for_function("space.then(s => s !== null)")
    assert tab.page.evaluate(
        "ownScale(readJson('space-data'), () => {}).inMeters({length: 4, sigma: null})"
    ) == {
        "length": 1.0,
        "sigma": None,
        "unit": "m",
        "words": ", with the scale set here",
    }
    tab.page.evaluate("document.getElementById('unset-scale').click()")
    assert (
        tab.page.evaluate("ownScale(readJson('space-data'), () => {}).inMeters({length: 4, sigma: 1}).unit")
        == ""
    )


def test_the_error_of_the_known_length_is_added(tab: Opened) -> None:
    """Two independent relative errors of 3 % and 4 % give 5 %."""
    tab.page.evaluate("localStorage.clear()")
    store = "localStorage.setItem(scaleKey(readJson('space-data')), JSON.stringify({meters: 2, relative: RELATIVE}))"
    tab.page.evaluate(store.replace("RELATIVE", "0.04"))
    make = "document.body.insertAdjacentHTML('beforeend', '<form id=set-scale><b id=unset-scale></b></form>')"
    if tab.page.locator("#set-scale").count() == 0:
        tab.page.evaluate(make)
    found = tab.page.evaluate("ownScale(readJson('space-data'), () => {}).inMeters({length: 10, sigma: 0.3})")
    assert (found["length"], found["sigma"]) == (pytest.approx(20.0), pytest.approx(1.0))
    tab.page.evaluate(store.replace("RELATIVE", "null"))
    found = tab.page.evaluate("ownScale(readJson('space-data'), () => {}).inMeters({length: 10, sigma: 0.3})")
    assert (found["length"], found["sigma"]) == (20.0, None)
    other = (
        "ownScale({...readJson('space-data'), radius: 7.5}, () => {}).inMeters({length: 10, sigma: 0.3}).unit"
    )
    assert tab.page.evaluate(other) == ""
    tab.page.evaluate("localStorage.clear()")


def test_a_page_of_one_view_turns_until_it_is_touched(tab: Opened) -> None:
    yaw = "space.then(s => s.view.eye().yaw)"
    at_rest = tab.page.evaluate(yaw)
    tab.page.emulate_media(reduced_motion="no-preference")
    tab.page.reload()
    tab.page.wait_for_function(f"Promise.resolve({yaw}).then(now => Math.abs(now - {at_rest}) > 0.01)")
    tab.page.mouse.click(5 + tab.page.locator("#space").bounding_box()["x"], 300)
    touched = tab.page.evaluate(yaw)
    tab.page.evaluate("() => new Promise(done => setTimeout(done, 150))")
    assert tab.page.evaluate(yaw) == touched
    tab.page.emulate_media(reduced_motion="reduce")


def test_the_legend_names_colors(tab: Opened) -> None:
    assert tab.page.locator("#legend li").count() == 0
    tab.page.click("summary:has-text('Layers')")
    tab.page.select_option("#point-color", "1")
    assert "px" in tab.page.inner_text("#legend")


def test_the_picture_is_saved_under_a_safe_name(empty_tab: Opened, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    xyz = np.array([[0.0, 0, 0], [10, 0, 0]])
    scene = SpaceScene("../a b<script>", "two points", "", (PointLayer("Points", xyz, RGB),))
    page.write_text(scene_page(scene, 10).html, encoding="utf-8")
    tab = empty_tab
    tab.open(page.as_uri())
    tab.page.click("summary:has-text('More')")
    with tab.page.expect_download() as given:
        tab.page.click("#save-picture")
    assert given.value.suggested_filename == "a_b_script_.png"
    saved = Image.open(io.BytesIO(Path(given.value.path()).read_bytes()))
    size = tab.page.evaluate(
        "[document.getElementById('space').width, document.getElementById('space').height]"
    )
    assert list(saved.size) == size and lit(np.asarray(saved.convert("RGB")).astype(float)) > 0


def test_no_barrier_is_known_to_axe(tab: Opened) -> None:
    tab.page.click("summary:has-text('Layers')")
    tab.page.click("#measure")
    wanted = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]}
    for scheme in ("light", "dark"):
        tab.page.emulate_media(color_scheme=scheme)
        found = Axe().run(tab.page, options=wanted)
        assert found.violations_count == 0, (scheme, found.generate_report())
    tab.page.emulate_media(color_scheme="light")


def test_keys_turn_and_measure(tab: Opened) -> None:
    tab.page.focus("#space")
    before = tab.page.evaluate("space.then(s => s.view.eye().yaw)")
    tab.page.keyboard.press("ArrowLeft")
    assert tab.page.evaluate("space.then(s => s.view.eye().yaw)") != before
    tab.page.focus("#measure")
    tab.page.keyboard.press("Space")
    tab.page.focus("#space")
    tab.page.keyboard.press("Enter")
    assert tab.page.inner_text("#measured") != ""


def test_of_many_points_a_part_is_drawn_while_the_eye_moves_and_all_at_rest(empty_tab: Opened) -> None:
    n = 400_000
    xyz = np.random.default_rng(0).uniform(-1, 1, (n, 3)).astype(np.float32)
    layer = PointLayer("Points", xyz, np.full((n, 3), 200, np.uint8))
    handle = view_scene(SpaceScene("many", "many points", "m", (layer,)), port=free_port(), block=False)
    tab = empty_tab
    tab.page.set_viewport_size({"width": 500, "height": 400})
    tab.open(handle.url)
    assert tab.page.evaluate("document.getElementById('space').dataset.points") == str(n)
    counts = tab.page.evaluate(
        """async () => { const { view } = await space, counts = [];
        for (let k = 0; k < 8; k++) { view.jumpTo({ ...view.eye(), yaw: view.eye().yaw + 0.1 });
          await new Promise(requestAnimationFrame);
          counts.push(Number(document.getElementById("space").dataset.points)); }
        return counts; }"""
    )
    assert 0 < min(counts[1:]) < n
    tab.improve()
    assert tab.page.evaluate("document.getElementById('space').dataset.points") == str(n)
    # All of them, gathered portion by portion, are what one drawing of all gives.
    gathered = np.asarray(
        Image.open(io.BytesIO(tab.page.locator("#space").screenshot())).convert("RGB")
    ).astype(float)
    whole = tab.rendered()
    middle = np.s_[120:260, 100:400]
    assert np.abs(gathered[middle] - whole[middle]).mean() < 1.0
    handle.stop()
