"""The small figures between the paragraphs show what the paragraphs say."""

import pytest

from epipole.geometry.disparity import depth_to_disparity


def test_one_pixel_of_a_whole_ray(tab):
    tab.open("01_disparity.html")
    pixels = set()
    for t in (1.0, 2.5, 6.0):
        tab.set(t=t)
        pixels.add(tab.page.locator("#ray-told").inner_text().split("pixel is ")[1])
    assert pixels == {"192."}


def test_disparity_on_the_curve(tab):
    tab.open("01_disparity.html")
    for Z, B in ((2.4, 0.12), (24.0, 0.12), (5.0, 0.3)):
        tab.set(Zd=Z, Bd=B)
        said = tab.page.locator("#shift-told").inner_text()
        d = float(said.split("disparity is ")[1].removesuffix(" px."))
        assert d == pytest.approx(depth_to_disparity(Z, focal_px=800.0, baseline=B), rel=0.005)


def test_three_vectors_in_one_plane_have_no_volume(tab):
    tab.open("02_epipolar.html")
    volumes = []
    for lift in (0.0, 0.4, -0.4, 0.8):
        tab.set(lift=lift)
        volumes.append(tab.shown()["volume"])
    assert volumes[0] == pytest.approx(0.0, abs=1e-12)
    assert volumes[1] == pytest.approx(-volumes[2]) and volumes[3] == pytest.approx(2 * volumes[1])


def test_a_pixel_on_a_line_has_product_zero(tab):
    tab.open("02_epipolar.html")
    tab.page.locator("#online").scroll_into_view_if_needed()
    box = tab.page.locator("#online").bounding_box()
    line = tab.page.locator("#online .ray.other").first.evaluate(
        "e => [e.x1, e.y1, e.x2, e.y2].map(v => v.baseVal.value)"
    )
    view = tab.page.locator("#online").evaluate("e => e.viewBox.baseVal.width")
    x1, y1, x2, y2 = line
    at = 400.0
    y = y1 + (y2 - y1) * (at - x1) / (x2 - x1)
    scale = box["width"] / view
    tab.page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.8 * box["height"])
    tab.page.mouse.down()
    tab.page.mouse.move(box["x"] + scale * (at + (view - 640) / 2), box["y"] + scale * y)
    tab.page.mouse.up()
    value = float(
        tab.page.locator("#online-told").inner_text().split("distance ")[1].split(" px")[0].replace("−", "-")
    )
    assert abs(value) < 1.5


def test_a_space_is_turned_by_keys_and_by_hand(tab):
    tab.open("02_epipolar.html")
    figure = tab.page.locator("#plane3d")
    at = "e => [...e.querySelectorAll('circle.object')].map(c => [c.cx.baseVal.value, c.cy.baseVal.value])[0]"
    before = figure.evaluate(at)
    figure.focus()
    tab.page.keyboard.press("ArrowLeft")
    turned = figure.evaluate(at)
    assert turned != before
    tab.page.keyboard.press("ArrowRight")
    assert figure.evaluate(at) == pytest.approx(before, abs=1e-3)
