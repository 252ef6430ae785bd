"""Scale bar, compass directions and rigs in the viewer."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_viewer_kinds import Opened
from viewer_scenes import three_cameras

from epipole.geometry import Rigid3
from epipole.io import write_colmap_model
from epipole.pipelines.viewing.run import scene_of
from epipole.report.space import space_data
from epipole.report.space_model import RIGS, scene_of_model
from epipole.report.space_scene import PointLayer, SpaceScene
from epipole.scene import Frames, Georeference, Reconstruction, Rigs
from epipole.viewer.scene_page import scene_page
from whole import IS_WHOLE

BERN = Georeference(46.95, 7.45, 550.0)
SIZES = ((1400, 900), (390, 844))
TEXT = "document.querySelector('#scale-bar span').textContent"


@pytest.fixture
def tab(browser: Any) -> Iterator[Opened]:
    opened = Opened(browser, None, *SIZES[0])
    yield opened
    opened.close()


def opened_page(tab: Opened, scene: SpaceScene, folder: Path) -> None:
    (folder / "page.html").write_text(scene_page(scene, 1000).html, encoding="utf-8")
    tab.open((folder / "page.html").as_uri())


def line_of_points(length: float, unit: str) -> SpaceScene:
    xyz = np.linspace([0.0, 0, 0], [length, 0, 0], 50)
    return SpaceScene("line", "a line", unit, (PointLayer("Points", xyz, np.full((50, 3), 200, np.uint8)),))


def bar_px(tab: Opened) -> float:
    return float(tab.page.evaluate("document.querySelector('#scale-bar i').style.width").removesuffix("px"))


@pytest.mark.parametrize("size", SIZES if IS_WHOLE else SIZES[:1])
def test_the_scale_bar_is_as_long_as_its_length_at_the_depth_of_the_center(
    size: tuple[int, int], tab: Opened, tmp_path: Path
) -> None:
    tab.page.set_viewport_size({"width": size[0], "height": size[1]})
    opened_page(tab, line_of_points(10.0, "m"), tmp_path)
    for factor in (1.0, 0.31, 5.3):
        tab.page.evaluate(
            "f => space.then(({ view }) => view.jumpTo({ ...view.eye(), dist: f * view.eye().dist }))", factor
        )
        tab.improve()
        value, unit = tab.page.evaluate(TEXT).split()
        meters = float(value) * {"cm": 0.01, "m": 1.0, "km": 1000.0}[unit]
        seen_px = tab.page.evaluate(
            """meters => space.then(({ view }) => { const c = document.getElementById("space"), b = view.basis(),
            end = view.eye().focus.map((v, k) => v + meters * b.r[k] - b.o[k]),
            on = a => a[0] * end[0] + a[1] * end[1] + a[2] * end[2];
            return view.focal() * c.clientWidth / c.width * on(b.r) / on(b.f); })""",
            meters,
        )
        assert bar_px(tab) == pytest.approx(seen_px, abs=0.06)
        assert 0.3 * min(130, 0.3 * size[0]) < bar_px(tab) <= 130
        assert value.lstrip("0.")[0] in "125"
        assert float(value) == float(f"{float(value):.1g}")
    bar, stage = (tab.page.locator(selector).bounding_box() for selector in ("#scale-bar", ".stage"))
    assert stage["x"] < bar["x"] and bar["x"] + bar["width"] < stage["x"] + stage["width"]
    assert bar["y"] + bar["height"] < stage["y"] + stage["height"]


def test_the_scale_bar_names_the_unit(tab: Opened, tmp_path: Path) -> None:
    cases = [
        (2e5, "m", "km"),
        (0.3, "m", "cm"),
        (30.0, "units of the file", "units"),
        (30.0, "m", "m"),
        (0.01, "m", "mm"),
        (30.0, "", "units"),
    ]
    for length, unit, name in cases if IS_WHOLE else cases[:3]:
        opened_page(tab, line_of_points(length, unit), tmp_path)
        text = tab.page.evaluate(TEXT)
        assert text.split()[1] == name
        label = tab.page.locator("#scale-bar").get_attribute("aria-label")
        assert label == f"Scale bar at the depth of the view's center: {text}"
    opened_page(tab, line_of_points(8.0, ""), tmp_path)
    assert tab.page.evaluate(TEXT) == "1 unit"


def test_the_scale_bar_takes_the_scale_that_a_person_set(tab: Opened, tmp_path: Path) -> None:
    opened_page(tab, line_of_points(30.0, ""), tmp_path)
    units = bar_px(tab) / float(tab.page.evaluate(TEXT).split()[0])
    tab.page.evaluate(
        "localStorage.setItem(scaleKey(readJson('space-data')), '{\"meters\":0.02,\"relative\":null}')"
    )
    tab.page.reload()
    tab.improve()
    value, unit = tab.page.evaluate(TEXT).split()
    assert unit == "cm"
    assert bar_px(tab) / float(value) == pytest.approx(units / 2.0, rel=0.02)
    tab.page.evaluate("localStorage.clear()")


def axes_of(tab: Opened) -> dict[str, tuple[float, float]]:
    """Label and direction on the screen, x right and y down."""
    found = tab.page.evaluate(
        """() => { const lines = [...document.querySelectorAll("#space-axes line")],
        texts = [...document.querySelectorAll("#space-axes text")];
        return texts.map((text, k) => [text.textContent, ...["1", "2"].map(end =>
          ["x", "y"].map(axis => Number(lines[k].getAttribute(axis + end))))]); }"""
    )
    return {label: (end[0] - start[0], end[1] - start[1]) for label, start, end in found}


def test_a_georeferenced_model_shows_north_and_has_it_at_the_top_from_above(
    tab: Opened, tmp_path: Path
) -> None:
    model = replace(three_cameras(20), georeference=BERN)
    opened_page(tab, scene_of_model(model, title="bern", unit="m"), tmp_path)
    assert set(axes_of(tab)) == {"E", "N", "up"}
    tab.page.click("summary:has-text('More')")
    tab.page.click("#view-above")
    tab.improve()
    axes = axes_of(tab)
    np.testing.assert_allclose(axes["N"], (0, -22), atol=0.1)
    np.testing.assert_allclose(axes["E"], (22, 0), atol=0.1)
    tab.page.click("summary:has-text('Layers')")
    tab.page.click("summary:has-text('Section')")
    assert "y, north from" in tab.page.inner_text(".section")
    opened_page(tab, scene_of_model(three_cameras(20), title="somewhere", unit="m"), tmp_path)
    assert set(axes_of(tab)) == {"x", "y", "z"}


def test_a_model_with_a_georeference_beside_it_is_in_meters_east_north_and_up(tmp_path: Path) -> None:
    write_colmap_model(replace(three_cameras(), georeference=BERN), tmp_path / "model")
    scene = scene_of(tmp_path / "model")
    assert (scene.unit, scene.is_enu) == ("m", True)
    write_colmap_model(three_cameras(), tmp_path / "other")
    scene = scene_of(tmp_path / "other")
    assert (scene.unit, scene.is_enu) == ("", False)


def with_rig(baseline: float) -> Reconstruction:
    """The first and second of `three_cameras` as one instant of a rig, and a third instant of one camera."""
    model = three_cameras(20)
    offset = Rigid3(np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 0], [-baseline, 0, 0]]))
    rigs = Rigs(np.array([0, 2], np.int32), np.zeros(2, np.int32), offset)
    first_and_last = model.frames.rig_from_world[np.array([0, 2])]
    frames = Frames(np.zeros(2, np.int32), first_and_last, np.full(2, np.nan))
    images = replace(model.images, frame=np.array([0, 0, 1], np.int32), sensor=np.array([1, 0, 0], np.int32))
    return replace(model, rigs=rigs, frames=frames, images=images)


def test_cameras_of_one_rig_are_connected() -> None:
    model = with_rig(0.5)
    scene = scene_of_model(model, title="rig", unit="m")
    (rig,) = scene.curves
    assert rig.name == RIGS
    np.testing.assert_allclose(rig.segments_in_world, [[[0, 0, 0], [0.5, 0, 0]]], atol=1e-12)
    assert [curve["name"] for curve in space_data(scene).numbers["curves"]] == [RIGS]


def test_single_cameras_and_the_views_of_one_panorama_have_no_lines() -> None:
    assert scene_of_model(three_cameras(), title="single", unit="m").curves == ()
    assert scene_of_model(with_rig(0.0), title="panorama", unit="m").curves == ()
